"""Reward terms and ends against obvious loops, and every end and bonus by hand."""

import math

import numpy as np
import pytest
import torch
import twin
from helpers import random_worlds, snapshot_of
from hypothesis import given
from hypothesis import strategies as st

from damian.common.errors import InputError
from damian.server.rewards import INDIVIDUAL, SYSTEM, Counters, RewardConfig, final_reward, reward
from damian.server.termination import EpisodeConfig, Status, share_of, status

NAMES = (*INDIVIDUAL, *SYSTEM)

seeds = st.integers(0, 2**32 - 1)
weights = st.sampled_from([0.0, 0.5, 1.0, -2.0])
shares = st.sampled_from([None, 0.1, 1 / 3, 0.5, 0.9, 1.0])


def features(seed, n_agents, n_worlds=3):
    """Every feature uniform in [0, 1], its ends and middle included."""
    rng = np.random.default_rng(seed)

    def draw():
        value = rng.random((n_worlds, n_agents))
        special = rng.choice([0.0, 0.5, 1.0], value.shape)
        return torch.as_tensor(np.where(rng.random(value.shape) < 0.3, special, value))

    counters = Counters(
        steps=torch.as_tensor(rng.integers(1, 20, n_worlds)),
        motions=torch.as_tensor(rng.integers(0, 5, (n_worlds, n_agents))),
    )
    return {name: draw() for name in NAMES}, counters


@given(
    seed=seeds,
    n_agents=st.integers(1, 5),
    given_weights=st.fixed_dictionaries(dict.fromkeys(NAMES, weights)),
    individual=weights,
    system=weights,
    drift=st.sampled_from(["smooth", "printed"]),
)
def test_every_term_equals_its_loop(seed, n_agents, given_weights, individual, system, drift):
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
    seen, counters = features(seed, n_agents)
    ours = reward(seen, counters, task)
    for b in range(3):
        for i in range(n_agents):
            values = {name: seen[name][b, i].item() for name in NAMES}
            expected = twin.terms(values, int(counters.motions[b, i]), task)
            assert {name: value[b, i].item() for name, value in ours.items()} == pytest.approx(
                expected, abs=1e-9
            )


def test_a_term_without_weight_is_not_computed():
    task = RewardConfig(spotted=1.0, coverage=2.0, source_time=3.0, individual=0.0)
    assert task.terms == ["source_time"]
    seen, counters = features(0, 2)
    assert reward({"source_time": seen["source_time"]}, counters, task).keys() == {"source_time"}


@pytest.mark.parametrize(
    ("theta", "printed", "smooth"),
    [(0.0, 0.0, 0.0), (0.25, 0.5, 0.5), (0.5, 1.0, 1.0), (0.75, 0.25, 0.5), (1.0, 0.0, 0.0)],
)
def test_the_drift_term_is_as_printed_or_smooth(theta, printed, smooth):
    counters = Counters(torch.ones(1), torch.ones(1, 1))
    for drift, expected in (("printed", printed), ("smooth", smooth)):
        task = RewardConfig(spotted=0.0, source_drift=1.0, drift=drift)
        ours = reward({"source_drift": torch.tensor([[theta]])}, counters, task)
        assert ours["source_drift"].item() == pytest.approx(expected)


@pytest.mark.parametrize(("motions", "share"), [(0, 1.0), (1, 1.0), (2, 0.5), (4, 0.25)])
def test_spotting_is_worth_less_the_more_motions_it_took(motions, share):
    counters = Counters(torch.ones(1), torch.tensor([[motions]]))
    task = RewardConfig(spotted=1.0, source_distance=1.0)
    seen = {"spotted": torch.ones(1, 1), "source_distance": torch.zeros(1, 1)}
    ours = reward(seen, counters, task)
    assert ours["spotted"].item() == ours["source_distance"].item() == share


@given(
    seed=seeds,
    n_agents=st.integers(1, 5),
    success=shares,
    discharged=shares,
    max_steps=st.sampled_from([None, 1, 5, 20]),
    since=st.booleans(),
)
def test_every_end_equals_its_loop(seed, n_agents, success, discharged, max_steps, since):
    episode = EpisodeConfig(max_steps, since, success, discharged)
    rng = np.random.default_rng(seed)
    worlds = random_worlds(seed, n_agents, 0.7, 0.6, n_worlds=6)
    dt = float(rng.choice([1.0, 0.5]))
    steps = rng.integers(1, 40, 6)
    worlds = [(float(n * dt), uavs) for n, (_, uavs) in zip(steps, worlds, strict=True)]
    for now, uavs in worlds:
        for uav in uavs:
            if uav.heard_at is not None:  # At the end of a step, as all detections are.
                uav.heard_at = now if uav.spots else float(rng.integers(round(now / dt) + 1)) * dt
    snapshot, server = snapshot_of(worlds)
    over = torch.zeros(6, dtype=torch.bool)
    ours = status(snapshot, torch.as_tensor(steps), server.now, over, dt, episode)
    expected = [
        twin.end(uavs, int(n), now, dt, episode) for n, (now, uavs) in zip(steps, worlds, strict=True)
    ]
    assert list(zip(*(flag.tolist() for flag in ours), strict=True)) == expected
    assert not (ours.terminated & ours.truncated).any()


def at_the_end(spots, battery=100.0, steps=5, over=False, **ends):
    """How one world stands whose UAVs spot or not."""
    (_, uavs), *_ = random_worlds(0, len(spots), 0.0, 0.0)
    for uav, flag in zip(uavs, spots, strict=True):
        uav.spots, uav.battery = flag, battery
    snapshot, server = snapshot_of([(float(steps), uavs)])
    config = EpisodeConfig(**ends)
    ended = status(snapshot, torch.tensor([steps]), server.now, torch.tensor([over]), 1.0, config)
    return tuple(flag.item() for flag in ended)


def test_a_success_at_the_last_step_is_a_success_and_not_a_time_failure():
    ends = {"max_steps": 5, "success_share": 1.0}
    assert at_the_end([True, True], **ends) == (True, True, False)
    assert at_the_end([True, False], **ends) == (False, False, True)
    assert at_the_end([True, False], steps=4, **ends) == (False, False, False)


def test_an_empty_fleet_or_a_source_that_is_over_terminates_without_success():
    ends = {"max_steps": 5, "discharged_share": 0.5}
    assert at_the_end([False], battery=0.0, **ends) == (False, True, False)
    assert at_the_end([False], over=True, max_steps=5, end_with_source=True) == (False, True, False)
    assert at_the_end([False], over=True, max_steps=None) == (False, False, False)


@pytest.mark.parametrize(
    ("share", "n_agents", "least"),
    [
        (0.3, 1, 1),
        (0.9, 3, 3),
        (0.5, 3, 2),
        (1 / 3, 3, 1),
        (0.1, 10, 1),
        (0.35, 3, 2),
        (0.55, 100, 55),
        (1, 7, 7),
    ],
)
def test_a_share_of_a_fleet_is_rounded_up_but_for_float_error(share, n_agents, least):
    assert share_of(share, n_agents) == least


def paid(success, terminated, truncated, **task):
    flags = Status(*(torch.tensor([flag]) for flag in (success, terminated, truncated)))
    return final_reward(flags, Counters(torch.tensor([4]), torch.zeros(1, 1)), RewardConfig(**task)).item()


def test_the_bonus_is_constant_or_over_the_steps_and_only_for_success():
    assert paid(True, True, False, bonus=2.0) == 2.0
    assert paid(True, True, False, bonus=2.0, bonus_over_steps=True) == 0.5
    assert paid(True, True, False, penalty=3.0) == 0.0
    assert paid(False, False, False, bonus=2.0, penalty=3.0) == 0.0


@pytest.mark.parametrize("terminated", [True, False])
def test_a_failure_costs_the_penalty_whether_by_time_or_by_battery(terminated):
    assert paid(False, terminated, not terminated, bonus=2.0, penalty=3.0) == -3.0


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (
            lambda: RewardConfig(coverage=math.nan),
            "reward.coverage: nan is not a finite weight",
        ),
        (
            lambda: RewardConfig(drift="rough"),
            "reward.drift: rough is not one of smooth, printed",
        ),
        (
            lambda: RewardConfig(desired_spotting=1.5),
            "reward.desired_spotting: 1.5 is not between 0 and 1",
        ),
        (
            lambda: EpisodeConfig(max_steps=0),
            "episode.max_steps: 0 is not at least 1",
        ),
        (
            lambda: EpisodeConfig(success_share=0.0),
            "episode.success_share: 0.0 is not above 0",
        ),
        (
            lambda: EpisodeConfig(discharged_share=1.5),
            "episode.discharged_share: 1.5 is not between 0 and 1",
        ),
    ],
)
def test_a_wrong_task_is_named_with_its_value(config, message):
    with pytest.raises(InputError) as error:
        config()
    assert str(error.value) == message
