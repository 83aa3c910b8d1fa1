"""Intents that UAVs send: they arrive with messages, tell next actions, and the policy learns from
those that it has read."""

import pytest
import torch
from helpers import backupdating_learner, log_prob_in_learning, square

from damian import DelayConfig, keys
from damian.keys import next_key
from damian.models.memory import add_recurrent_state
from damian.server.config import EpisodeConfig, ObservationConfig, RewardConfig

SLOTS, STEPS, WORLDS = 5, 30, 4


def build(example, agents=3):
    """A learner of UAVs that cover a square, whose messages are 1 to 3 steps late or lost, and its
    environment."""
    scenario = square(
        agents=agents,
        delay=DelayConfig(obs="1..3", loss=0.1, messages=SLOTS),
        observation=ObservationConfig(global_features=["coverage", "others"], own=True),
        reward=RewardConfig(coverage=1.0),
        episode=EpisodeConfig(max_steps=13, success_share=None),
    )
    learner = example.IntentConfig(
        name="intent:IntentConfig",
        steps=STEPS,
        epochs=1,
        minibatches=2,
        width=16,
        intent_width=3,
        intent_steps=2,
        intent_batch=40,
        intent_lr=0.01,
    )
    learner, env = backupdating_learner(scenario, learner)
    add_recurrent_state(env, learner.actor)
    return learner, env


@torch.no_grad()
def collected(env, actor):
    """A batch [4, 30]."""
    return env.rollout(STEPS, actor, break_when_any_done=False)


def test_a_uav_reads_the_newest_intent_that_has_arrived(example):
    learner, env = build(example)
    batch = collected(env, learner.actor)
    sent = learner.intents.encoded(batch[keys.OBSERVATION], batch[keys.TIMELINE]).detach()
    place = env.uav_env.server.messages(batch[keys.MESSAGE]).position
    place = place / env.uav_env.simulation.airspace.scale[0]
    count = batch[keys.STEP_COUNT].squeeze(-1)
    late = batch[next_key(keys.DELAY)].squeeze(-1)
    ages = set()
    for world in range(WORLDS):
        for step in range(STEPS):
            for receiver in range(3):
                for sender in range(3):
                    found = batch[example.HEARD][world, step, receiver, (sender - receiver) % 3]
                    expected = torch.zeros(7)
                    for age in range(min(SLOTS, int(count[world, step]) + 1)):
                        then = step - age
                        # What is known at a reset has no delay.
                        known_at_once = sender == receiver or count[world, then] == 0
                        delay = 0 if known_at_once else late[world, then - 1, sender]
                        late_enough = age == 0 if sender == receiver else age > 0
                        if late_enough and 0 <= delay <= age:
                            way = 2 * (place[world, then, sender] - place[world, step, receiver])
                            expected = torch.tensor(
                                [*sent[world, then, sender], *way, age / SLOTS, 1]
                            )
                            ages.add(age)
                            break
                    torch.testing.assert_close(found, expected)
    assert ages >= {0, 1, 2, 3}


def test_an_intent_learns_to_tell_next_actions(example):
    learner, env = build(example)
    batch = collected(env, learner.actor)
    # Half of the UAVs choose action 0 throughout, half action 1, and one column shows which.
    chosen = torch.randint(2, (WORLDS, 1, 3)).expand(WORLDS, STEPS, 3)
    shown = batch[keys.OBSERVATION].clone()
    shown[..., 0] = chosen.float()
    batch[keys.OBSERVATION] = shown
    batch[keys.ACTION] = chosen
    batch[keys.READY] = torch.ones_like(batch[keys.READY])
    with torch.no_grad():  # that nothing else is chosen need not be learnt
        learner.infer.bias.unflatten(0, (learner.config.horizon, -1))[:, :2] += 10
    losses = torch.stack([learner.learn_intents(batch) for _ in range(200)])
    assert losses[-20:].mean() < 0.1 * torch.tensor(2.0).log()


def test_actions_after_the_end_of_an_episode_are_not_inferred(example):
    learner, env = build(example)
    batch = collected(env, learner.actor)
    done = batch[next_key(keys.DONE)]
    batch[next_key(keys.DONE)] = torch.ones_like(done)  # only the first action counts
    batch[keys.READY] = torch.ones_like(batch[keys.READY])
    for _ in range(2):
        learner.learn_intents(batch)
    rows = learner.infer.weight.grad.unflatten(0, (learner.config.horizon, -1))
    assert rows[0].abs().sum() > 0
    assert not rows[1:].any()


def test_learning_intents_does_not_change_what_the_policy_has_done(example):
    learner, env = build(example)
    batch = collected(env, learner.actor)
    before = log_prob_in_learning(learner.actor, batch)
    torch.testing.assert_close(before, batch[keys.ACTION_LOG_PROB])
    learner.learn(batch.clone())
    policy = log_prob_in_learning(learner.actor, batch)
    assert not policy.equal(before)
    for _ in range(5):
        learner.learn_intents(batch)
    assert log_prob_in_learning(learner.actor, batch).equal(policy)


def test_a_policy_of_three_flies_six(example):
    (three, _), (six, env) = build(example), build(example, agents=6)
    six.actor.load_state_dict(three.actor.state_dict())
    assert collected(env, six.actor)[example.HEARD].shape[-3:] == (6, 6, 7)


@pytest.mark.parametrize(
    ("changes", "named"),
    [({"horizon": STEPS}, "learner.horizon"), ({"discount": 0.0}, "learner.discount")],
)
def test_settings_are_refused_by_name(example, changes, named):
    learner, _ = build(example)
    with pytest.raises(ValueError, match=named):
        example.IntentConfig(name="intent:IntentConfig", **changes).check(learner.setup)
