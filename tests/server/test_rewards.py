"""Reward terms and ends of episodes equal those of plain loops."""

import numpy as np
import pytest
import torch
import twin
from helpers import messages_of, random_worlds
from hypothesis import given
from hypothesis import strategies as st

from damian.server.config import BUILT_IN
from damian.server.rewards import Counters, RewardConfig, reward, terms_of
from damian.server.termination import EpisodeConfig, status

seeds = st.integers(0, 2**32 - 1)
weights = st.sampled_from([0.0, 0.5, 1.0, -2.0])
shares = st.sampled_from([None, 0.1, 1 / 3, 0.5, 0.9, 1.0])


def features(seed, n_agents, n_worlds=3):
    """Random features in [0, 1], often exactly 0, 0.5 or 1, and random counters."""
    rng = np.random.default_rng(seed)

    def draw():
        value = rng.random((n_worlds, n_agents))
        special = rng.choice([0.0, 0.5, 1.0], value.shape)
        return torch.as_tensor(np.where(rng.random(value.shape) < 0.3, special, value))

    counters = Counters(
        steps=torch.as_tensor(rng.integers(1, 20, n_worlds)),
        motions=torch.as_tensor(rng.integers(0, 5, (n_worlds, n_agents))),
    )
    return {name: draw() for name in BUILT_IN}, counters


@given(
    seed=seeds,
    n_agents=st.integers(1, 5),
    given_weights=st.fixed_dictionaries(dict.fromkeys(BUILT_IN, weights)),
    individual=weights,
    system=weights,
    drift=st.sampled_from(["smooth", "printed"]),
)
def test_every_term_equals_that_of_a_plain_loop(seed, n_agents, given_weights, individual, system, drift):
    task = RewardConfig(
        **given_weights,
        individual=individual,
        system=system,
        drift=drift,
        desired_spotting=0.7,
        desired_distance=0.4,
        desired_distance_not_spotting=0.6,
        desired_distance_spotting=0.2,
    )
    inputs, counters = features(seed, n_agents)
    ours = reward(inputs, counters, terms_of(task))
    for b in range(3):
        for i in range(n_agents):
            values = {name: inputs[name][b, i].item() for name in BUILT_IN}
            expected = twin.terms(values, int(counters.motions[b, i]), task)
            found = {name: value[b, i].item() for name, value in ours.items()}
            assert found == pytest.approx(expected, abs=1e-6)


def test_a_built_in_term_can_be_used_again_with_parameters_of_its_own():
    again = {"term": "mean_distance", "weight": 2.0, "name": "close", "desired_distance": 0.2}
    unused = {"term": "battery", "weight": 0.0, "name": "unused"}
    task = RewardConfig(spotted=0.0, mean_distance=1.0, custom=[again, unused])
    inputs, counters = features(0, 3)
    ours = reward(inputs, counters, terms_of(task))
    assert [*ours] == task.terms == ["mean_distance", "close"]
    near = RewardConfig(spotted=0.0, mean_distance=2.0, desired_distance=0.2)
    assert ours["close"].equal(reward(inputs, counters, terms_of(near))["mean_distance"])
    assert not ours["close"].equal(2 * ours["mean_distance"])


@given(
    seed=seeds,
    n_agents=st.integers(1, 5),
    success=shares,
    discharged=shares,
    max_steps=st.sampled_from([None, 1, 5, 20]),
    since=st.booleans(),
)
def test_every_end_of_an_episode_equals_that_of_a_plain_loop(
    seed, n_agents, success, discharged, max_steps, since
):
    episode = EpisodeConfig(max_steps, since, success, discharged)
    rng = np.random.default_rng(seed)
    worlds = random_worlds(seed, n_agents, 0.7, 0.6, n_worlds=6)
    dt = float(rng.choice([1.0, 0.5]))
    steps = rng.integers(1, 40, 6)
    worlds = [(float(n * dt), uavs) for n, (_, uavs) in zip(steps, worlds, strict=True)]
    for now, uav in [(now, uav) for now, uavs in worlds for uav in uavs if uav.heard_at is not None]:
        # All detections happen at the end of a step.
        uav.heard_at = now if uav.spots else float(rng.integers(round(now / dt) + 1)) * dt
    messages, _ = messages_of(worlds)
    over = torch.zeros(6, dtype=torch.bool)
    ours = status(messages, torch.as_tensor(steps), over, dt, episode)
    expected = [
        twin.end(uavs, int(n), now, dt, episode) for n, (now, uavs) in zip(steps, worlds, strict=True)
    ]
    assert list(zip(*(flag.tolist() for flag in ours), strict=True)) == expected
    assert not (ours.terminated & ours.truncated).any()


def status_of(spots, empty=False, steps=5, over=False, **ends):
    """Success, terminated and truncated of one world in which the UAVs spot the source or not."""
    (_, uavs), *_ = random_worlds(0, len(spots), 0.0, 0.0)
    for uav, flag in zip(uavs, spots, strict=True):
        uav.spots, uav.empty = flag, empty
    messages, _ = messages_of([(float(steps), uavs)])
    config = EpisodeConfig(**ends)
    ended = status(messages, torch.tensor([steps]), torch.tensor([over]), 1.0, config)
    return tuple(flag.item() for flag in ended)


def test_empty_batteries_or_the_end_of_the_sources_walk_terminate_without_success():
    ends = {"max_steps": 5, "discharged_share": 0.5}
    assert status_of([False, False], empty=True, **ends) == (False, True, False)
    assert status_of([False], over=True, max_steps=5, end_with_source=True) == (False, True, False)
    assert status_of([False], over=True, max_steps=None) == (False, False, False)
