"""Flights, against recorded trajectories of the original, and their limits."""

import json
from pathlib import Path

import pytest
import torch
from hypothesis import given, strategies as st

from damian.common.errors import InputError
from damian.world.motion import MotionConfig, flight_levels, minimum_time, poses, time_law

GOLDEN = json.loads(
    (Path(__file__).parents[1] / "data" / "motion_energy_coverage.json").read_text()
)
CASES = GOLDEN["uav_trajectories"]["cases"]
limits = st.floats(0.1, 50.0)


def derivatives(length, time, degree, n=2001):
    """Speed and acceleration along a phase, sampled densely, by autograd (float64)."""
    t = torch.linspace(0, 1, n, dtype=torch.float64) * time
    t.requires_grad_(True)
    (v,) = torch.autograd.grad((length * time_law(t / time, degree)).sum(), t, create_graph=True)
    (a,) = torch.autograd.grad(v.sum(), t)
    return v.detach(), a


@pytest.mark.parametrize("case", CASES, ids=lambda c: f"{c['degree']}-{c['flight_level']}")
def test_recorded_flights_have_the_same_positions(case):
    start = {"takeoff": 0.0, "flight": case["T_takeoff"]}
    start["landing"] = case["T_takeoff"] + case["T_flight"]
    rows = case["continuous_samples_phase_t_pos_vel_acc"]
    assert len(rows) == 15
    expected = torch.tensor([row[2:5] for row in rows], dtype=torch.float64)
    elapsed = torch.tensor([start[r[0]] + r[1] for r in rows], dtype=torch.float64)
    names = ("A", "B", "flight_level", "T_takeoff", "T_flight")
    origin, target, level, *times = (
        torch.tensor([case[name]] * 15, dtype=torch.float64) for name in names
    )
    position, crossed = poses(
        torch.stack([origin, target], -2), level, elapsed, *times, case["degree"]
    )
    torch.testing.assert_close(
        position,
        expected,
        atol=1e-4,
        rtol=0,
    )
    way = torch.linalg.vector_norm(expected[:, :2] - origin, dim=-1)
    length = torch.linalg.vector_norm(target - origin, dim=-1)
    torch.testing.assert_close(
        crossed * length,
        way,
        atol=1e-4,
        rtol=0,
    )


@pytest.mark.parametrize("degree", [3, 5, 7])
@given(length=st.floats(0.1, 1000.0), speed=limits, acceleration=limits)
def test_minimum_times_reach_one_limit_and_exceed_none(degree, length, speed, acceleration):
    time = minimum_time(torch.tensor(length, dtype=torch.float64), degree, speed, acceleration)
    v, a = derivatives(length, time, degree)
    fastest, hardest = (x.abs().max().item() for x in (v, a))
    assert fastest <= speed * (1 + 1e-9)
    assert hardest <= acceleration * (1 + 1e-9)
    assert max(fastest / speed, hardest / acceleration) >= 1 - 1e-4


def test_flight_levels_are_separated_and_lie_within_their_bounds():
    config = MotionConfig(min_level=1.0, max_level=2.2, level_separation=0.4)
    assert flight_levels(config, 4) == pytest.approx([1.0, 1.4, 1.8, 2.2])
    assert len(flight_levels(MotionConfig(max_level=1.7, level_separation=0.1), 8)) == 8
    with pytest.raises(InputError, match=r"^motion\.max_level: 2\.2 m leaves room for 4 .* 5 UAVs"):
        flight_levels(config, 5)
