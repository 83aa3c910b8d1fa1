"""The search for the nearest landing points against a loop over all of them in exact arithmetic."""

import math

import numpy as np
import pytest
import torch
from exact_distance import nearest_by_loop
from hypothesis import given, settings
from hypothesis import strategies as st

from damian.world import nearest
from damian.world.nearest import build_grid


def some_points(rng, kind, n) -> np.ndarray:
    """Scattered points, points in two far clusters, or a lattice whose points are often equally far."""
    if kind == "lattice":
        east, north = np.divmod(np.arange(n), math.ceil(math.sqrt(n)))
        return np.stack([east * 30.0, north * 30 * math.sin(math.pi / 4)], -1)[rng.permutation(n)]
    points = rng.uniform(-200, 200, (n, 2))
    return points + 5000.0 * (kind == "clusters") * rng.integers(0, 2, (n, 1))


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    kinds=st.lists(st.sampled_from(["scattered", "clusters", "lattice"]), min_size=1, max_size=3),
    n=st.integers(1, 9),
)
def test_the_nearest_points_are_those_of_a_loop_in_exact_arithmetic(seed, kinds, n):
    rng = np.random.default_rng(seed)
    lattices = [some_points(rng, kind, int(rng.integers(1, 40))) for kind in kinds]
    grid = build_grid(lattices, [float(rng.uniform(1e2, 1e6)) for _ in kinds], int(rng.integers(1, 20)))
    region = rng.integers(len(kinds), size=12)
    target = rng.uniform(-6000, 6000, (12, 2)) * rng.choice([0.01, 1.0], (12, 1))
    on_points = rng.random(12) < 0.4  # from a landing point, by a round distance
    for i in np.flatnonzero(on_points):
        points, angle = lattices[region[i]], math.radians(45 * rng.integers(8))
        move = rng.choice([0.0, 15.0, 30.0, 45.005]) * np.array([math.sin(angle), math.cos(angle)])
        target[i] = points[rng.integers(len(points))] + move
    ours = grid.nearest(torch.as_tensor(region), torch.as_tensor(target), n)
    expected = [
        nearest_by_loop(lattices[r].tolist(), t, n) for r, t in zip(region, target.tolist(), strict=True)
    ]
    assert ours.tolist() == expected
    if n <= (most := max(map(len, lattices))):
        region, target = torch.as_tensor(region), torch.as_tensor(target)
        assert grid.nearest_of_all(region, target, n, most).tolist() == expected


@pytest.mark.parametrize("distance", [10.0, 12.345, 0.005, 77.775, 100 * math.sqrt(2)])
def test_of_points_at_one_distance_in_any_direction_the_lowest_id_is_nearest(distance):
    angles = np.arange(1, 360)
    points = distance * np.stack([np.sin(np.radians(angles)), np.cos(np.radians(angles))], -1)
    grid = build_grid([points], [distance**2], 5)
    ours = grid.nearest(torch.zeros(1, dtype=torch.long), torch.zeros(1, 2, dtype=torch.float64), 359)
    assert ours.tolist() == [list(range(359))]


@pytest.mark.parametrize("slots", [2**18, 1000])
def test_many_targets_find_what_a_comparison_with_every_point_finds(monkeypatch, slots):
    monkeypatch.setattr(nearest, "_SLOTS", slots)
    rng = np.random.default_rng(0)
    points, target = rng.uniform(0, 1000, (300, 2)), rng.uniform(0, 1000, (3000, 2))
    grid = build_grid([points], [1e6], 5)
    ours = grid.nearest(torch.zeros(3000, dtype=torch.long), torch.as_tensor(target), 12)
    distance = np.floor(100 * np.linalg.norm(points - target[:, None], axis=-1) + 0.500001)
    np.testing.assert_array_equal(ours, np.argsort(distance, axis=1, kind="stable")[:, :12])


def test_no_targets_have_no_points():
    grid = build_grid([np.zeros((1, 2))], [1.0], 1)
    assert grid.nearest(torch.zeros(0, dtype=torch.long), torch.zeros(0, 2).double(), 3).shape == (0, 3)
