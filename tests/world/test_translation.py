"""A region that is moved with everything in it gives the same worlds, bit for bit."""

import functools

import numpy as np
import pytest
import torch

from damian.common.tensors import tree_map
from damian.world.battery import BatteryConfig
from damian.world.config import WorldConfig
from damian.world.landing import ActionConfig
from damian.world.regions.sources import RegionConfig
from damian.world.signal_source import SourceConfig
from damian.world.simulation import Simulation

SQUARE = [[0.0, 0.0], [210.0, 0.0], [210.0, 210.0], [0.0, 210.0]]
"""A side is seven steps of the lattice: many points are equally near, and some lie on the boundary."""
RAGGED = [[-33.42, -140.43], [-129.57, -16.79], [-60.0, 20.0], [-100.17, 108.35], [146.39, -17.27]]


def simulation(vertices, offset, kind):
    """Worlds with given places, moved by an offset [m]."""

    def moved(*places):
        return (np.array(places) + offset).tolist()

    region = RegionConfig(
        kind="vertices",
        vertices=moved(*vertices),
        start_positions=moved([0.5, 11.0], [30.25, 30.0], [61.0, 3.0]),
        initial_conditions=1,
    )
    return Simulation(
        WorldConfig(
            region=region,
            source=SourceConfig(motion="dynamic", position=moved([30.0, 20.7])[0]),
            battery=BatteryConfig(
                enabled=True, capacity_kwh=0.05, charging_points=moved([9.0, 9.0], [70, 8.5])
            ),
            actions=ActionConfig(kind=kind),
        ),
        dt=1.0,
        stops=2,
        seed=0,
    )


def rollout(worlds, kind, n_steps):
    """States of four worlds over the steps, with random actions."""
    generator = torch.Generator().manual_seed(0)
    state = tree_map(lambda x: x.repeat_interleave(4, 0), worlds.initial)
    for _ in range(n_steps):
        shape = (4, 3, 2) if kind == "continuous" else (4, 3)
        action = torch.rand(shape, generator=generator)
        state = worlds.step(state, action if kind == "continuous" else (40 * action).long())
        yield state


@functools.cache
def unmoved(shape, kind):
    return list(rollout(simulation(shape, (0.0, 0.0), kind), kind, 60))


def leaves(state):
    return [*state[:-1], *state.sent]


def check_moved(vertices, offset, kind):
    """Assert that moving the region and all places changes no bit of a rollout."""
    before = unmoved(tuple(map(tuple, vertices)), kind)
    for ours, expected in zip(rollout(simulation(vertices, offset, kind), kind, 60), before, strict=True):
        assert ours.goal.equal(expected.goal)
    assert all(a.equal(b) for a, b in zip(leaves(ours), leaves(expected), strict=True))
    assert len({*ours.goal.flatten().tolist()}) > 3


@pytest.mark.parametrize(
    ("vertices", "offset", "kind"),
    [
        (SQUARE, (1000.0, 1000.0), "discrete"),
        (RAGGED, (-9_876_543.21, 0.1), "continuous"),
    ],
)
def test_moving_the_region_and_all_places_changes_no_bit_of_a_rollout(vertices, offset, kind):
    check_moved(vertices, offset, kind)
