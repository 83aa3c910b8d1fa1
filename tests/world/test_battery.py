"""Battery: recorded figures of the original implementation."""

import json

import pytest
import torch
from helpers import DATA, KEEPS_GOING, act, everything, fresh, random_actions
from hypothesis import given, strategies as st

from damian.world.battery import BatteryConfig, charge_gain, flight_drain, observed, used_so_far

ENERGY = json.loads((DATA / "motion_energy_coverage.json").read_text())["energy"]
BATTERY = BatteryConfig()


def tensor(value):
    return torch.tensor(value, dtype=torch.float64)


def test_recorded_flights_have_the_same_drain():
    rows = [row for row in ENERGY["consumption"] if row["mode"] == "estimate"]
    assert len(rows) == 5
    for row in rows:
        vertical = row["T_takeoff_or_landing"]
        distance = row["speed"] * row["T_flight"]
        drain = flight_drain(tensor(vertical), tensor(distance), BATTERY)
        assert drain.item() == pytest.approx(row["battery_percent"], rel=1e-4)


def test_recorded_charging_has_the_same_gain():
    assert len(ENERGY["charged"]) == 4
    for row in ENERGY["charged"]:
        gain = charge_gain(tensor(row["dt"]), BATTERY)
        assert gain.item() == pytest.approx(row["battery_percent"], rel=1e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_recorded_levels_are_observed_as_the_same_levels(dtype):
    levels, expected = zip(*ENERGY["observable_level"], strict=True)
    assert observed(torch.tensor(levels, dtype=dtype), BATTERY).tolist() == list(expected)


@given(
    share=st.floats(0, 1.5),
    vertical=st.floats(0.1, 20),
    cruise=st.floats(0, 100),
    part=st.floats(0, 1),
)
def test_the_drain_so_far_is_the_sum_over_the_phases_of_a_flight(share, vertical, cruise, part):
    elapsed = share * (2 * vertical + cruise)
    cruised = part * 150.0
    flown = min(elapsed, vertical)
    if elapsed > vertical + cruise:
        flown = min(elapsed - cruise, 2 * vertical)
    expected = flown * 100 * 10 / (9 * 12 * 0.9) / 3600 + cruised / 20 * 100 * 10 / (9 * 12) / 3600
    values = (tensor(x) for x in (elapsed, vertical, cruise, cruised))
    assert used_so_far(*values, BATTERY).item() == pytest.approx(
        expected,
        rel=1e-9,
        abs=1e-12,
    )


def test_levels_fall_by_the_drain_of_instant_flights_and_rise_while_uavs_hold():
    env = fresh(everything(episode=KEEPS_GOING), num_worlds=4)
    battery = env.scenario.battery
    climb = env.simulation.vehicles.vertical(env.state)
    gain = charge_gain(torch.tensor(1.0), battery)
    flown = 0
    for _ in range(12):
        before = env.state
        act(env, random_actions(env))
        way = (env.state.position - before.position)[..., :2].norm(dim=-1)
        flies = way > 0
        drain = torch.where(flies, flight_drain(climb, way, battery), -gain)
        expected = (before.battery - drain).clamp(0, 100)
        torch.testing.assert_close(env.state.battery, expected, rtol=0, atol=1e-3)
        flown += int(flies.sum())
    assert 20 < flown < 140
