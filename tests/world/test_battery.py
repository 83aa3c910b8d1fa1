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
    cruise_drain,
    flight_drain,
    observed,
    used_so_far,
)
from damian.world.motion import fly, minimum_time

DATA = Path(__file__).parents[1] / "data"
ENERGY = json.loads((DATA / "motion_energy_coverage.json").read_text())["energy"]
BATTERY = BatteryConfig()


def tensor(value):
    return torch.tensor(value, dtype=torch.float64)


def test_the_defaults_equal_the_recorded_parameters():
    golden = ENERGY["params"]
    assert (BATTERY.engine_power_kw, BATTERY.reference_speed) == (golden["p_eng"], golden["v_ref"])
    assert (BATTERY.capacity_kwh, BATTERY.efficiency) == (golden["p_bat"], golden["b_efficiency"])
    assert (BATTERY.charging_power_kw, BATTERY.resolution) == (
        golden["p_bat_charging"],
        golden["b_res"],
    )
    full = charge_gain(tensor(golden["T_empty_to_full_s"]), BATTERY)
    assert full.item() == pytest.approx(100.0)


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


@given(multiple=st.integers(0, 20), error=st.floats(-4e-4, 4e-4))
def test_float_error_does_not_change_the_observed_level(multiple, error):
    level = torch.tensor(5.0 * multiple + error)
    assert observed(level, BATTERY).item() == 5.0 * multiple


@pytest.mark.parametrize("degree", [3, 5, 7])
@pytest.mark.parametrize("n_steps", [3, 17, 400])
def test_the_drain_of_a_flight_does_not_depend_on_the_time_step(degree, n_steps):
    # The expected drain integrates the rate 100 (p_eng v / v_ref) / (p_bat eff) per hour over time.
    origin, target, level = tensor([[0.0, 0.0]]), tensor([[30.0, 40.0]]), tensor([2.0])
    vertical, cruise = minimum_time(tensor([2.0, 50.0]), degree, max_speed=5.0, max_acceleration=2.0)

    def cruised(n):
        elapsed = torch.linspace(0, 1, n + 1, dtype=torch.float64) * (2 * vertical + cruise)
        return elapsed, fly(origin, target, level, elapsed, vertical, cruise, degree).cruised

    elapsed, fine = cruised(20_000)
    speed = fine.diff() / elapsed.diff()
    rate = 100 * (10 * speed / 20) / (9 * 12) / 3600
    steps = cruise_drain(cruised(n_steps)[1].diff(), BATTERY).sum()
    assert steps.item() == pytest.approx((rate * elapsed.diff()).sum().item(), rel=1e-9)


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
