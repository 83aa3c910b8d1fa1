"""QMIX as a learner of one's own: what it draws and how it explores; it is trained, resumed and
evaluated."""

import csv

import pytest
import torch
from extensions import TINY
from helpers import everything, learning
from tensordict import TensorDict
from torchrl.data import ReplayBuffer

import damian
from damian import UavEnv, keys
from damian.models.config import MlpConfig
from damian.replay.time_storage import TimeStorage
from damian.world.config import ActionConfig


def learner_of(example, env, **changed):
    buffer = ReplayBuffer(storage=TimeStorage(1000))
    config = example.QmixConfig(updates=2, batch_size=64, epsilon=0.4, epsilon_end=0.4)
    return config.make(env, learning(MlpConfig(hidden=[8]), worlds=4, **changed), buffer)


@pytest.mark.parametrize("mixer", ["qmix", pytest.param("vdn", marks=pytest.mark.slow)])
def test_it_is_trained_evaluated_and_resumed_with_its_epsilon(run, mixer):
    words = [
        *TINY,
        "delay.obs=2",
        "aware=backupdate",
        f"learner.mixer={mixer}",
        "learner.annealed=1",
    ]
    first = run(*words, "learner=qmix:QmixConfig", "learner.steps=8")
    run("resume=run", "trust=true", "frames=256", name="unused")
    with (first / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert float(rows[-1]["epsilon"]) == pytest.approx(0.05), "it goes on where it was"
    assert 0 < float(rows[-1]["loss"]) < 10
    assert {"trained", "trained, deterministic"} <= {*damian.results(first)["policy"]}


def test_the_policy_takes_the_legal_action_of_highest_value_and_explores_among_the_legal_ones(
    example,
):
    env = UavEnv(everything(actions=ActionConfig(kind="discrete")), 4, 0)
    actor = example.QmixConfig(epsilon=0.4).make_actor(env, MlpConfig(hidden=[8]))
    seen = env.reset().select(keys.OBSERVATION, keys.ACTION_MASK)
    legal = seen[keys.ACTION_MASK]
    values = actor[0].module.network(seen[keys.OBSERVATION])
    best = values.masked_fill(~legal, -torch.inf).argmax(-1)
    assert legal.sum(-1).min() < legal.shape[-1]
    expected = 0.4 * legal / legal.sum(-1, keepdim=True)
    expected.scatter_add_(-1, best.unsqueeze(-1), torch.full(best.shape, 0.6).unsqueeze(-1))
    policy = actor.get_dist(seen)
    torch.testing.assert_close(policy.probs, expected)
    assert policy.deterministic_sample.equal(best)


@pytest.mark.parametrize("backupdate", [False, True])
def test_it_draws_what_can_no_longer_change_once_it_corrects(example, backupdate):
    env = UavEnv(everything(), 4, 0)
    learner = learner_of(example, env, longest_delay=5, backupdate=backupdate)
    drawn = []
    learner.joint = lambda steps, joint=learner.joint: (drawn.append(steps), joint(steps))[1]
    steps = env.rollout(20, break_when_any_done=False)
    steps["count"] = torch.arange(20).expand(4, 20).clone()
    learner.learn(steps)
    latest = max(int(each["count"].max()) for each in drawn)
    assert latest == (14 if backupdate else 19)


def test_a_team_step_has_the_mean_reward_all_critic_inputs_and_one_action_in_flight(example):
    env = UavEnv(everything("polynomial"), 4, 0)
    learner = learner_of(example, env)
    steps = env.rollout(20, break_when_any_done=False).flatten(0, 1)
    valid = torch.rand(80, 1) < 0.7
    team = learner.joint(TensorDict({**steps, keys.VALID: valid}, [80]))
    steps = steps[valid.squeeze(-1)]
    assert len(team) == len(steps) < 80
    for k in range(len(team)):
        for found, source in ((team[k], steps[k]), (team[k]["next"], steps[k]["next"])):
            for i in range(env.scenario.agents):
                mask = source[keys.ACTION_MASK][i]
                ready = bool(source[keys.READY][i])
                only = torch.arange(len(mask)) == 0
                assert found[keys.ACTION_MASK][i].equal(mask if ready else only)
            assert found["joint"].equal(torch.cat([*source[keys.GLOBAL_OBSERVATION]]))
        for action, ready, chosen in zip(
            team[k][keys.ACTION], steps[k][keys.READY], steps[k][keys.ACTION], strict=True
        ):
            assert action == (chosen if ready else 0)
        rewards = steps[k][keys.next_key(keys.REWARD)]
        torch.testing.assert_close(team[k]["next", "reward"].squeeze(), rewards.mean())
    assert not steps[keys.READY].all()
    assert torch.isfinite(learner.loss(team)["loss"])
