"""Flights, against recorded trajectories of the original, their limits, and a slow reference (twin)."""

import json
import math
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from damian.common.errors import InputError
from damian.world.motion import (
    MotionConfig,
    flight_levels,
    minimum_time,
    poses,
    time_law,
)

GOLDEN = json.loads((Path(__file__).parents[1] / "data" / "motion_energy_coverage.json").read_text())
CASES = GOLDEN["uav_trajectories"]["cases"]
DEGREES = [3, 5, 7]

sizes = st.floats(0.1, 1000.0)
limits = st.floats(0.1, 50.0)


class Times(NamedTuple):
    vertical: torch.Tensor
    cruise: torch.Tensor


def phase_times(origin, target, level, motion):
    """Shortest durations of takeoff (and landing) and of cruise [s]."""
    limits = (motion.degree, motion.max_speed, motion.max_acceleration)
    cruise = torch.linalg.vector_norm(target - origin, dim=-1)
    return Times(minimum_time(level, *limits), minimum_time(cruise, *limits))


def slow_law(tau, degree):
    """The time laws as printed polynomials (paper, eq. 1)."""
    tau = min(max(tau, 0.0), 1.0)
    return {
        3: 3 * tau**2 - 2 * tau**3,
        5: 10 * tau**3 - 15 * tau**4 + 6 * tau**5,
        7: 35 * tau**4 - 84 * tau**5 + 70 * tau**6 - 20 * tau**7,
    }[degree]


def slow_pose(origin, target, level, elapsed, *, vertical, cruise, degree):
    """Position and distance cruised of one UAV, with one branch per phase."""
    length = math.dist(origin, target)
    if elapsed < vertical:
        return [*origin, level * slow_law(elapsed / vertical, degree)], 0.0
    if elapsed < vertical + cruise:
        s = slow_law((elapsed - vertical) / cruise, degree)
        x, y = (a + s * (b - a) for a, b in zip(origin, target, strict=True))
        return [x, y, level], s * length
    s = slow_law((elapsed - vertical - cruise) / vertical, degree)
    return [*target, level * (1 - s)], length


def derivatives(length, time, degree, n=2001):
    """Speed and acceleration along a phase, sampled densely, by autograd (float64)."""
    t = torch.linspace(0, 1, n, dtype=torch.float64) * time
    t.requires_grad_(True)
    (v,) = torch.autograd.grad((length * time_law(t / time, degree)).sum(), t, create_graph=True)
    (a,) = torch.autograd.grad(v.sum(), t)
    return v.detach(), a


@pytest.mark.parametrize("case", CASES, ids=lambda c: f"{c['degree']}-{c['flight_level']}")
def test_recorded_flights_have_the_same_positions_velocities_and_accelerations(case):
    start = {"takeoff": 0.0, "flight": case["T_takeoff"]}
    start["landing"] = case["T_takeoff"] + case["T_flight"]
    rows = case["continuous_samples_phase_t_pos_vel_acc"]
    assert len(rows) == 15
    expected = torch.tensor([row[2:] for row in rows], dtype=torch.float64)
    elapsed = torch.tensor([start[r[0]] + r[1] for r in rows], dtype=torch.float64)
    elapsed.requires_grad_(True)
    n = len(rows)
    pose = poses(
        torch.tensor(case["A"], dtype=torch.float64).expand(n, 2),
        torch.tensor(case["B"], dtype=torch.float64).expand(n, 2),
        torch.full((n,), case["flight_level"], dtype=torch.float64),
        elapsed,
        torch.full((n,), case["T_takeoff"], dtype=torch.float64),
        torch.full((n,), case["T_flight"], dtype=torch.float64),
        case["degree"],
    )
    velocity, acceleration = [], []
    for axis in pose.position.unbind(-1):
        (v,) = torch.autograd.grad(axis.sum(), elapsed, create_graph=True)
        velocity.append(v)
        acceleration.append(torch.autograd.grad(v.sum(), elapsed, retain_graph=True)[0])
    torch.testing.assert_close(pose.position.detach(), expected[:, :3], atol=1e-4, rtol=0)
    # Derivatives jump where two phases meet, so they are compared only inside the phases.
    inside = [i for i in range(n) if i % 5 in (1, 2, 3)]
    torch.testing.assert_close(torch.stack(velocity, -1)[inside], expected[inside, 3:6], atol=1e-4, rtol=0)
    torch.testing.assert_close(torch.stack(acceleration, -1)[inside], expected[inside, 6:], atol=1e-4, rtol=0)


@pytest.mark.parametrize("degree", DEGREES)
@given(length=sizes, speed=limits, acceleration=limits)
def test_minimum_times_reach_one_limit_and_exceed_none(degree, length, speed, acceleration):
    time = minimum_time(torch.tensor(length, dtype=torch.float64), degree, speed, acceleration)
    v, a = derivatives(length, time, degree)
    fastest, hardest = (x.abs().max().item() for x in (v, a))
    assert fastest <= speed * (1 + 1e-9)
    assert hardest <= acceleration * (1 + 1e-9)
    assert max(fastest / speed, hardest / acceleration) >= 1 - 1e-4


@pytest.mark.parametrize("degree", DEGREES)
def test_flights_equal_those_of_the_twin_at_dense_times(degree):
    motion = MotionConfig(degree=degree)
    generator = torch.Generator().manual_seed(degree)
    origin, target = 100 * torch.randn(2, 4, 3, 1, 2, generator=generator, dtype=torch.float64)
    target[0, 0] = origin[0, 0]  # a UAV that only goes up and down
    level = torch.tensor([1.0, 1.5, 8.0], dtype=torch.float64)[:, None].expand(4, 3, 1)
    times = phase_times(origin, target, level, motion)
    share = torch.linspace(-0.02, 1.1, 200, dtype=torch.float64)
    elapsed = (2 * times.vertical + times.cruise) * share.clamp_min(0)
    pose = poses(origin, target, level, elapsed, *times, degree)
    assert pose.position.shape == (4, 3, 200, 3)
    assert pose.cruised.shape == (4, 3, 200)
    for b in range(4):
        for n in range(3):
            for k in range(200):
                position, cruised = slow_pose(
                    origin[b, n, 0].tolist(),
                    target[b, n, 0].tolist(),
                    level[b, n, 0].item(),
                    elapsed[b, n, k].item(),
                    vertical=times.vertical[b, n, 0].item(),
                    cruise=times.cruise[b, n, 0].item(),
                    degree=degree,
                )
                assert pose.position[b, n, k].tolist() == pytest.approx(position, abs=1e-9)
                assert pose.cruised[b, n, k].item() == pytest.approx(cruised, abs=1e-9)


def test_flight_levels_are_separated_and_lie_within_their_bounds():
    config = MotionConfig(min_level=1.0, max_level=2.2, level_separation=0.4)
    assert flight_levels(config, 4) == pytest.approx([1.0, 1.4, 1.8, 2.2])
    assert len(flight_levels(MotionConfig(max_level=1.7, level_separation=0.1), 8)) == 8
    with pytest.raises(InputError, match=r"^motion\.max_level: 2\.2 m leaves room for 4 .* 5 UAVs"):
        flight_levels(config, 5)
