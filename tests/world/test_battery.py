"""Battery: recorded figures of the original implementation."""

import json
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from damian.world.battery import (
    BatteryConfig,
    charge_gain,
    flight_drain,
    observed,
    used_so_far,
)

DATA = Path(__file__).parents[1] / "data"
ENERGY = json.loads((DATA / "motion_energy_coverage.json").read_text())["energy"]
BATTERY = BatteryConfig()


def tensor(value):
    return torch.tensor(value, dtype=torch.float64)


def test_recorded_flights_have_the_same_drain():
    rows = [row for row in ENERGY["consumption"] if row["mode"] == "estimate"]
    assert len(rows) == 5
    for row in rows:
        vertical, distance = row["T_takeoff_or_landing"], row["speed"] * row["T_flight"]
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
    if elapsed <= vertical:
        flown = elapsed
    elif elapsed <= vertical + cruise:
        flown = vertical
    else:
        flown = min(elapsed - cruise, 2 * vertical)
    expected = flown * 100 * 10 / (9 * 12 * 0.9) / 3600 + cruised / 20 * 100 * 10 / (9 * 12) / 3600
    values = (tensor(x) for x in (elapsed, vertical, cruise, cruised))
    assert used_so_far(*values, BATTERY).item() == pytest.approx(expected, rel=1e-9, abs=1e-12)
