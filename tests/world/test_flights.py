"""Where UAVs start, and where their legal actions lead."""

import pytest
import torch
from helpers import KEEPS_GOING, SQUARE, act, fresh, random_actions, sent_messages, square, usecase

from damian import ScenarioConfig, UavEnv
from damian.world.battery import BatteryConfig, flight_drain
from damian.world.config import RegionConfig
from damian.world.state import State


def test_uavs_start_on_different_points_or_on_one_or_on_the_given_ones():
    apart = sent_messages(UavEnv(square(), num_worlds=64).reset()).position
    assert (torch.cdist(apart, apart) + 1e9 * torch.eye(3)).min() > 1
    region = RegionConfig(kind="vertices", vertices=SQUARE, start_together=True)
    together = UavEnv(square(region=region), num_worlds=64).reset()
    place = sent_messages(together).position
    assert torch.cdist(place, place).max() == 0
    assert len({tuple(p) for p in place[:, 0].tolist()}) > 10
    env = UavEnv(usecase(2))
    given = sent_messages(env.reset()).position + env.simulation.airspace.offset[0]
    assert given[0].tolist() == [pytest.approx([62.85586449, -119.2183645], abs=1e-4)] * 3


@pytest.mark.parametrize("energy", [False, True])
def test_masked_actions_hold_and_legal_actions_lead_to_their_nearest_point(energy):
    battery = BatteryConfig(enabled=energy, capacity_kwh=0.05)
    scenario = ScenarioConfig(
        agents=1,
        region=RegionConfig(min_area=20_000, max_area=50_000, pool=2, initial_conditions=8),
        battery=battery,
        episode=KEEPS_GOING,
    )
    n_actions = scenario.actions.n_actions
    env = fresh(scenario, num_worlds=n_actions)
    masked = reached = 0
    for _ in range(30):
        act(env, random_actions(env))
        # Copy the state of world 0 to every world; then each world tries another action.
        copies = [field[:1].expand_as(field).contiguous() for field in env.state[:-1]]
        level = 100 * torch.rand(1) if energy else torch.tensor([100.0])
        state = State(*copies, env.state.sent)._replace(battery=level.expand(n_actions, 1).clone())
        env.state = state
        legal = env.simulation.action_mask(state)[0, 0]
        act(env, torch.arange(n_actions)[:, None])
        moved = (env.state.goal != state.goal).squeeze(-1)
        assert not moved[~legal].any()
        nearest = env.simulation.candidates.distance[state.goal[0, 0]]
        drain = (
            flight_drain(env.simulation.vehicles.vertical(env.state), nearest, battery)
            if energy
            else nearest * 0
        )
        assert legal.equal((nearest == 0) | (drain <= level))  # takeoff and landing count as well
        assert moved[legal].equal(nearest[legal] > 0)
        masked = masked + int((~legal).sum())
        reached = reached + int(moved.sum())
    assert masked > 100
    assert reached > 100
