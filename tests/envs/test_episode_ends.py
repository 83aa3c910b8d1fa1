"""Ends of episodes and their rewards (paper, section 4.1), batteries, and the source."""

import copy
import itertools
import math

import pytest
import torch
from helpers import (
    EAST,
    HERE,
    KEEPS_GOING,
    MOTIONS,
    act,
    both_motions,
    clock,
    flight,
    fresh,
    go,
    one_uav,
    random_actions,
    sent_messages,
    square,
    walking,
)

from damian.server.rewards import RewardConfig
from damian.server.termination import EpisodeConfig
from damian.world.battery import BatteryConfig, charge_gain, flight_drain
from damian.world.motion import MotionConfig
from damian.world.signal_source import SourceConfig

FAR = [[390.0, 10.0]]

# Ends of episodes.


@pytest.mark.parametrize(("share", "needed"), [(0.3, 1), (0.5, 2), (1.0, 3)])
def test_success_needs_a_share_of_the_uavs_to_spot_the_source_at_once(share, needed):
    episode = EpisodeConfig(max_steps=None, success_share=share)
    env = fresh(square(source=SourceConfig(level_db=143.0), episode=episode), num_worlds=256)
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        output = act(env, random_actions(env, generator))
        enough = sent_messages(output).spotted.sum(-1, keepdim=True) >= needed
        assert enough.any()
        assert not enough.all()
        assert output["success"].equal(enough)
        assert output["terminated"].equal(enough)
        assert not output["truncated"].any()


def test_the_time_limit_truncates_and_does_not_terminate():
    env = fresh(one_uav(episode=EpisodeConfig(max_steps=3)))
    ends = [go(env, HERE) for _ in range(3)]
    assert [td["truncated"].item() for td in ends] == [False, False, True]
    assert [td["done"].item() for td in ends] == [False, False, True]
    assert not any(td["terminated"].item() or td["success"].item() for td in ends)


@both_motions
@pytest.mark.parametrize(
    ("level", "resolution", "empty"),
    [
        (5.0, 5.0, False),
        (4.9, 5.0, True),  # observed as 0
        (4.9, 0.1, False),
        (1e-3, 1e-4, True),  # too little for the shortest flight
    ],
)
def test_a_battery_is_empty_at_the_observed_level_0_or_if_it_allows_only_holding(
    motion, level, resolution, empty
):
    battery = BatteryConfig(enabled=True, capacity_kwh=0.5, resolution=resolution, charging_points=FAR)
    episode = EpisodeConfig(max_steps=None, discharged_share=1.0)
    task = RewardConfig(penalty=2.0)
    env = fresh(one_uav(battery=battery, motion=MOTIONS[motion], episode=episode, reward=task))
    env.state = env.state._replace(battery=torch.tensor([[level]]))
    output = go(env, HERE)
    assert sent_messages(output).empty.item() == empty
    assert output["done"].item() == empty
    assert output["agents", "reward"].item() == (-2.0 if empty else 0.0)
    assert (output["terminated"] & ~output["truncated"] & ~output["success"]).item() == empty


def test_after_its_walk_the_source_is_silent_and_the_episode_terminates_if_so_configured():
    once = {"n_hotspots": 1, "min_stops": 1, "max_stops": 1, "min_wait": 0.9, "max_wait": 0.9}
    source = walking(level_db=170.0, after_walk="stop", local_distance=1e-3, **once)
    for terminates in (True, False):
        episode = EpisodeConfig(max_steps=None, end_with_source=terminates)
        env = fresh(one_uav(source=source, episode=episode))
        output = go(env, HERE)
        assert sent_messages(output).spotted.item()
        assert not output["done"].item()
        output = go(env, HERE)
        assert output["terminated"].item() == terminates
        assert not sent_messages(output).spotted.item()


@pytest.mark.parametrize("emission", ["constant", "per_stop"])
def test_a_source_that_begins_its_walk_anew_is_heard_for_the_whole_episode(emission):
    source = walking(level_db=170.0, emission=emission, emission_probability=0.4, n_hotspots=2, max_stops=3)
    env = fresh(one_uav(source=source, clock=clock("1m"), episode=KEEPS_GOING), num_worlds=64)
    heard, rounds = [], 60.0 * 150 / env.simulation.walk.depart[:, -1]
    assert rounds.min() > 2
    for _ in range(150):
        output = go(env, HERE)
        heard.append(sent_messages(output).spotted)
        assert not output["done"].any()
    share = torch.stack(heard).float()
    assert share[50:].mean().item() == pytest.approx(1.0 if emission == "constant" else 0.4, abs=0.03)
    assert (emission == "constant") == share.all()


@pytest.mark.parametrize(("over_steps", "bonus"), [(False, 3.0), (True, 1.5)])
def test_success_gives_the_bonus_and_a_timeout_the_penalty(over_steps, bonus):
    source = SourceConfig(level_db=130.0, position=[160.0, 100.0])
    episode = EpisodeConfig(max_steps=3, success_share=1.0)
    task = RewardConfig(spotted=0.0, bonus=3.0, bonus_over_steps=over_steps, penalty=0.5)
    env = fresh(one_uav(source=source, episode=episode, reward=task))
    assert go(env, HERE)["agents", "reward"].item() == 0.0
    assert go(env, EAST)["agents", "reward"].item() == bonus
    env.reset()
    assert go(env, HERE, HERE, HERE)["agents", "reward"].item() == -0.5


# Batteries.


def test_the_battery_drain_of_a_flight_does_not_depend_on_the_length_of_a_step():
    drained, cost = [], None
    for period in ("1s", "0.5s", "0.25s"):
        battery = BatteryConfig(enabled=True, capacity_kwh=0.1, charging_points=FAR)
        env = fresh(one_uav(battery=battery, motion=MotionConfig("polynomial"), clock=clock(period)))
        go(env, EAST)
        origin, goal = (env.simulation.points[p.item()] for p in (env.state.origin, env.state.goal))
        length = torch.linalg.vector_norm(goal - origin)
        cost = flight_drain(env.state.vertical[0, 0], length, battery).item()
        duration = flight(env)
        levels = [env.state.battery.item()]
        while not env.simulation.vehicles.on_ground(env.state).all():
            go(env, HERE)
            levels.append(env.state.battery.item())
        assert all(a >= b for a, b in itertools.pairwise(levels))
        assert len(levels) == math.ceil(duration / env.simulation.dt)
        go(env, HERE)
        drained.append(100 - env.state.battery.item())
    assert cost > 1
    assert drained == pytest.approx([cost] * 3, abs=1e-3)


@both_motions
def test_a_uav_does_not_fly_to_a_landing_point_beyond_the_reach_of_its_battery(motion):
    battery = BatteryConfig(enabled=True, capacity_kwh=0.5, charging_points=FAR)
    env = fresh(one_uav(battery=battery, motion=MOTIONS[motion]))
    start = copy.deepcopy(env.state)
    go(env, EAST)
    length = torch.linalg.vector_norm(
        env.simulation.points[env.state.goal.item()] - env.simulation.points[start.goal.item()]
    )
    cost = flight_drain(env.simulation.vehicles.vertical[0], length, battery)
    for factor, flies in ((0.99, False), (1.01, True)):
        env.state = start._replace(battery=factor * cost.view(1, 1))
        go(env, EAST)
        assert bool((env.state.goal != start.goal).item()) == flies


def test_uavs_charge_only_at_charging_points():
    battery = BatteryConfig(enabled=True, capacity_kwh=0.5, charging_points=[[160.0, 100.0]])
    env = fresh(one_uav(battery=battery))
    env.state = env.state._replace(battery=torch.full((1, 1), 50.0))
    go(env, HERE, HERE)
    assert env.state.battery.item() == 50.0
    go(env, EAST)
    after_flight = env.state.battery.item()
    assert after_flight < 50.0
    go(env, HERE)
    gain = charge_gain(torch.tensor(1.0), battery).item()
    assert env.state.battery.item() == pytest.approx(after_flight + gain)
