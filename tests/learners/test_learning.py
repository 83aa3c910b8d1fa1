"""MAPPO: actors and critics, advantages, losses, importance ratios with back-updating,
divergence."""

import itertools
import math

import pytest
import torch
from helpers import both_motions
from torch import nn

from damian import ScenarioConfig, UavEnv, keys, make_env
from damian.common.errors import InputError
from damian.learners.base import divergence
from damian.learners.mappo import MappoConfig, add_advantages, executed_choices
from damian.models.actor import make_actor
from damian.models.config import MlpConfig
from damian.models.critic import make_critic
from damian.server.config import EpisodeConfig, RewardConfig
from damian.world.config import ActionConfig, MotionConfig, RegionConfig

SMALL = MlpConfig(hidden=[16])
REWARD = ("next", "agents", "reward")


def scenario(**changes):
    region = RegionConfig(min_area=20_000, max_area=40_000, initial_conditions=16)
    return ScenarioConfig(**{"agents": 3, "region": region, **changes})


def collect(motion, kind):
    """A batch with episodes of 9 steps, terminated in every other world and truncated in the
    others."""
    config = scenario(
        episode=EpisodeConfig(max_steps=9),
        motion=MotionConfig(kind=motion),
        actions=ActionConfig(kind=kind),
        reward=RewardConfig(spotted=1.0, source_distance=1.0),
    )
    env = UavEnv(config, 8)
    actor = make_actor(env, SMALL)
    critic = make_critic(env, SMALL)
    batch = env.rollout(24, actor, break_when_any_done=False)
    batch["next", "terminated"][::2] = batch["next", "done"][::2]
    return batch, critic


@both_motions
def test_advantages_are_the_generalised_estimate_over_the_decisions_of_each_uav(motion):
    config = MappoConfig(gamma=0.9, lmbda=0.8, normalize_advantage=False)
    batch, critic = collect(motion, "discrete")
    add_advantages(batch, critic, config)
    value, reward = (batch[key].squeeze(-1) for key in (("agents", "state_value"), REWARD))
    next_value = batch["next", "agents", "state_value"].squeeze(-1)
    ready = batch["agents", "ready"]
    next_ready = batch["next", "agents", "ready"]
    compared = 0
    for world, uav in itertools.product(range(8), range(3)):
        estimate = 0.0  # of the decision after this one
        for t in reversed(range(24)):
            if not ready[world, t, uav]:
                continue
            earned = 0.0
            discount = 1.0
            last = t
            while True:  # until the next decision, or the end of the episode or of the batch
                earned += discount * reward[world, last, uav].item()
                discount *= 0.9
                over = batch["next", "done"][world, last].item()
                if over or next_ready[world, last, uav] or last == 23:
                    break
                last += 1
            alive = not batch["next", "terminated"][world, last].item()
            bootstrap = alive * discount * next_value[world, last, uav].item()
            delta = earned + bootstrap - value[world, t, uav].item()
            later = 0.0 if over or last == 23 else discount * 0.8 * estimate
            estimate = delta + later
            advantage = batch["agents", "advantage"][world, t, uav].item()
            assert advantage == pytest.approx(estimate, abs=1e-5)
            compared += 1
    assert compared > 100


def test_a_choice_earns_what_follows_the_execution_of_its_action():
    delay = 2
    config = MappoConfig(gamma=0.9, lmbda=1.0, normalize_advantage=False)
    batch, critic = collect("instant", "discrete")
    choices, executed = executed_choices(batch, delay)
    add_advantages(choices, critic, config, executed)
    reward = batch[REWARD].squeeze(-1)
    done, terminated = (batch["next", key].squeeze(-1) for key in ("done", "terminated"))
    value = choices["agents", "state_value"].squeeze(-1)
    next_value = choices["next", "agents", "state_value"].squeeze(-1)
    target = choices["agents", "value_target"].squeeze(-1)
    counted = set()
    for world, t in itertools.product(range(8), range(24 - delay)):
        counts = not done[world, t : t + delay].any()
        assert executed[world, t] == counts
        assert (choices["agents", "ready"][world, t] == counts).all()
        expected = value[world, t]
        last = t + delay  # the step that executes the latest choice
        earned = 0.0
        while counts:
            earned += 0.9 ** (last - delay - t) * reward[world, last]
            if done[world, last] or last == 23:
                left = 0.9 ** (last - delay - t + 1) * next_value[world, last - delay]
                expected = earned + left * ~terminated[world, last]
                break
            last += 1
        assert target[world, t].tolist() == pytest.approx(expected.tolist(), abs=1e-5)
        counted.add(counts)
    assert counted == {True, False}


def test_a_nan_counts_only_if_weights_are_wrong():
    network = nn.Linear(2, 2)
    components = {
        "actor": network,
        "optimizer": torch.optim.Adam(network.parameters()),
        "other": nn.ReLU(),
    }
    assert divergence(components, {"loss": 1.0, "not known yet": math.nan}) is None
    assert divergence(components, {"a": 1.0, "b": -math.inf}) == "b is -inf"
    for value in (math.nan, -2e5):
        with torch.no_grad():
            network.bias[1] = value
        found = divergence(components, {})
        assert found == f"a weight of actor is {abs(value):.3g}, not at most 100000"


@pytest.mark.parametrize("shared", [True, False])
def test_uavs_that_see_the_same_choose_alike_only_with_a_shared_actor(shared):
    env = make_env(ScenarioConfig(agents=3), 4, 0)
    actor = make_actor(env, MlpConfig(hidden=[16], shared=shared))
    td = env.reset()
    td[keys.OBSERVATION] = td[keys.OBSERVATION][:, :1].expand_as(td[keys.OBSERVATION]).clone()
    td[keys.ACTION_MASK] = torch.ones_like(td[keys.ACTION_MASK])
    logits = actor.get_dist(td).logits
    assert logits[:, 0].allclose(logits[:, 1]) == shared
    assert len([*actor.parameters()]) == 4


def test_own_actors_have_no_memory():
    with pytest.raises(InputError, match=r"model.shared: False goes with model.rnn=none"):
        MlpConfig(shared=False, rnn="gru")
