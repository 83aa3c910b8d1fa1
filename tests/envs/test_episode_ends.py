"""Ends of episodes (paper, section 4.1), batteries, and the end of the source."""

import copy

import pytest
import torch
from helpers import MOTIONS, act, both_motions, fresh, one_uav, sent_messages, walking

from damian.server.config import EpisodeConfig, RewardConfig
from damian.world.battery import BatteryConfig, charge_gain, flight_drain

FAR = [[390.0, 10.0]]
HERE, EAST = [[0.0, 0.0]], [[1.0, 0.25]]
"""Continuous actions of one UAV: hold, and 100 m east (a quarter of a turn from north)."""


def go(env, *actions):
    """Step through the actions; return the output of the last step."""
    for action in actions:
        after = act(env, torch.tensor([action]))
    return after


# Ends of episodes.


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
    battery = BatteryConfig(
        enabled=True, capacity_kwh=0.5, resolution=resolution, charging_points=FAR
    )
    episode = EpisodeConfig(max_steps=None, discharged_share=1.0)
    task = RewardConfig(penalty=2.0)
    env = fresh(
        one_uav(
            battery=battery,
            motion=MOTIONS[motion],
            episode=episode,
            reward=task,
        )
    )
    env.state = env.state._replace(battery=torch.tensor([[level]]))
    output = go(env, HERE)
    assert sent_messages(output).empty.item() == empty
    assert output["done"].item() == empty
    assert output["agents", "reward"].item() == (-2.0 if empty else 0.0)
    assert (output["terminated"] & ~output["truncated"] & ~output["success"]).item() == empty


def test_after_its_walk_the_source_is_silent_and_the_episode_terminates_if_so_configured():
    once = {
        "n_hotspots": 1,
        "min_stops": 1,
        "max_stops": 1,
        "min_wait": 0.9,
        "max_wait": 0.9,
    }
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


# Batteries.


@both_motions
def test_a_uav_does_not_fly_to_a_landing_point_beyond_the_reach_of_its_battery(motion):
    battery = BatteryConfig(enabled=True, capacity_kwh=0.5, charging_points=FAR)
    env = fresh(one_uav(battery=battery, motion=MOTIONS[motion]))
    start = copy.deepcopy(env.state)
    go(env, EAST)
    length = torch.linalg.vector_norm(
        env.simulation.points[env.state.goal.item()] - env.simulation.points[start.goal.item()]
    )
    cost = flight_drain(env.simulation.vehicles.vertical(env.state)[0], length, battery)
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
