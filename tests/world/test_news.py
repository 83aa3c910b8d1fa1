"""Flights that end elsewhere than commanded, and UAVs that fail for a while, against plain loops."""

import functools
import itertools
import math
from collections import Counter
from dataclasses import replace

import pytest
import torch
from helpers import DENTED, KEEPS_GOING, act, both_motions, clock, fresh, random_actions

from damian import ScenarioConfig
from damian.common import counter_rng
from damian.common.errors import InputError
from damian.world.battery import cruise_range, flight_drain
from damian.world.config import (
    ActionConfig,
    BatteryConfig,
    FailureConfig,
    MotionConfig,
    RegionConfig,
)

SPEED = 50.0
HARDEST = 25.0
CHANCES = [0.0, 0.3, 1.0, 0.6, 0.6, 0.6]
WORLD = ScenarioConfig(
    region=RegionConfig(kind="vertices", vertices=DENTED, lattice_step=50.0),
    battery=BatteryConfig(enabled=True, capacity_kwh=0.02, charging_power_kw=1.0),
    actions=ActionConfig(distances=[0.0, 110.0, 230.0]),
    episode=KEEPS_GOING,
    clock=clock("2s"),
)


def aborting(kind, agents=3):
    """Worlds in which flights of the UAVs are aborted with different probabilities."""
    motion = MotionConfig(kind, max_speed=SPEED, max_acceleration=HARDEST, abort=CHANCES[:agents])
    return replace(WORLD, motion=motion, agents=agents)


def shares(state, world, stream, count):
    """The first uniform draws of a stream in a world in this step."""
    stream = torch.tensor(counter_rng.number_of(stream))
    counters = state.episode[world], state.steps[world], torch.arange(count)
    return counter_rng.uniform(state.seed[world], stream, *counters).tolist()


def elsewhere(env, state, world, uav, start, reach, taken):
    """Where an aborted flight of a UAV ends; None if there is no place."""
    candidates = env.simulation.candidates
    n_draws = len(candidates.hold) + 1
    draws = shares(state, world, "elsewhere", n_draws * (uav + 1))[n_draws * uav :]
    ends = zip(
        candidates.nearest[start].tolist(), candidates.distance[start].tolist(), draws, strict=False
    )
    found = {}
    for point, length, draw in ends:
        if length <= reach:
            found.setdefault(point, draw)
    return min({*found} - taken, key=found.get, default=None)


@functools.cache
def leg(env, origin, goal):
    """Length [m] and duration [s] of a cruise between landing points."""
    ends = torch.tensor([[origin], [goal]])
    length = env.simulation.airspace.length(*ends).item()
    hard = math.sqrt(10 * math.sqrt(3) / 3 * length / HARDEST)
    return length, max(15 / 8 * length / SPEED, hard)


@pytest.mark.parametrize("agents", [3, 6])
@both_motions
def test_aborted_flights_are_those_of_a_plain_loop(motion, agents):
    instant = motion == "instant"
    env = fresh(aborting(motion, agents), num_worlds=4)
    vehicles = env.simulation.vehicles
    climbs = vehicles.vertical(env.state).tolist()
    flights = {}
    counts = Counter()
    for _ in range(15 if instant else 40):
        before = env.state
        action = random_actions(env)
        commanded = env.simulation.decide(before, action, None).goal
        chooses = vehicles.ready(before)
        expected = commanded.tolist()
        for (world, goals), uav in itertools.product(enumerate(expected), range(agents)):
            if chooses[world, uav]:
                stops = [before.goal[world, uav].item(), goals[uav]]
                flights[world, uav] = [stops, before.battery[world, uav], 0]
            stops, level, steps = flights[world, uav]
            length, seconds = leg(env, *stops[:2])
            if instant:
                turns = True
                start = stops[0]
                length = 0
            else:  # as it comes to its landing, or instead of holding
                start = stops[1]
                descends = 2 * steps < climbs[uav] + seconds <= 2 * steps + 2
                turns = len(stops) == 2 and (steps == 0 if start == stops[0] else descends)
            if turns and shares(before, world, "abort", agents)[uav] < CHANCES[uav]:
                used = flight_drain(torch.tensor(climbs[uav]), torch.tensor(length), WORLD.battery)
                reach = cruise_range(level - used, WORLD.battery).clamp(min=0).item()
                taken = {*goals, *commanded[world].tolist()}
                end = elsewhere(env, before, world, uav, start, reach, taken)
                if end is not None:
                    goals[uav] = end
                    stops[1 if start == stops[0] else 2 :] = [end]
            flights[world, uav][2] += 1
        act(env, action)
        after = env.state
        assert after.goal.tolist() == expected
        assert all(len({*goals}) == agents for goals in expected)
        moved = after.position - before.position
        if instant:
            assert after.sent.position.equal(env.simulation.points[after.goal])
            counts["turned"] += int((after.goal != commanded).sum())
            continue
        assert moved.norm(dim=-1).max() < 2 * SPEED
        for (world, uav), (stops, level, steps) in flights.items():
            legs = [leg(env, *pair) for pair in itertools.pairwise(stops)]
            flies = stops[0] != stops[-1] or len(stops) == 3
            seconds = 2 * climbs[uav] * flies + sum(each[1] for each in legs)
            lands = max(math.ceil(seconds / 2 - 1e-5), 1)
            assert after.message_sent[world, uav] == (steps >= lands or steps == 1)
            if steps == lands and flies:
                length = torch.tensor(sum(each[0] for each in legs))
                used = flight_drain(torch.tensor(climbs[uav]), length, WORLD.battery)
                assert after.battery[world, uav].item() == pytest.approx(
                    (level - used).item(), abs=1e-3
                )
                assert after.sent.trail[world, uav, 0] == stops[-1]
                counts["turned"] += len(stops) == 3
    assert counts["turned"] > 20


@both_motions
def test_failed_uavs_are_silent_and_stay_where_they_are(motion):
    scenario = replace(aborting(motion), failure=FailureConfig(0.1, duration=10.0))
    env = fresh(scenario, num_worlds=16)
    vehicles = env.simulation.vehicles
    failed = torch.zeros(16, 3, dtype=torch.bool)
    began = joined = 0
    for _ in range(40):
        before = env.state
        output = act(env, random_actions(env))["agents"]
        after = env.state
        was = failed.clone()
        for world in range(16):
            for uav, draw in enumerate(shares(after, world, "failure", 3)):
                failed[world, uav] = draw >= 2 / 10 if was[world, uav] else draw < 0.1
        assert after.failed.equal(failed)
        stood = was & vehicles.on_ground(before)
        assert after.goal[stood].equal(before.goal[stood])
        assert after.position[stood].equal(before.position[stood])
        assert not output["ready"][failed].any()
        assert output["action_mask"][failed].sum(-1).eq(1).all()
        assert not after.message_sent[failed].any()
        assert output["message"][failed].equal(before.sent.pack()[failed])
        joins = was & ~failed & vehicles.on_ground(after)
        assert after.message_sent[joins].all()
        assert after.sent.trail[joins, 0].equal(after.goal[joins])
        assert after.sent.landed[joins, 0].equal(after.sent.time[joins])
        began += int((failed & ~was).sum())
        joined += int(joins.sum())
    assert min(began, joined) > 40


def test_actions_without_a_mask_cannot_be_aborted():
    continuous = ActionConfig("continuous")
    with pytest.raises(InputError, match=r"motion.abort: \[0.0, 0.3, 1.0\] needs discrete"):
        replace(aborting("instant"), actions=continuous)
