"""A region that is moved with everything in it gives the same worlds, bit for bit."""

import numpy as np
import pytest

from damian.world.config import BatteryConfig, RegionConfig, SourceConfig, WorldConfig
from damian.world.simulation import Simulation

SQUARE = [[0.0, 0.0], [210.0, 0.0], [210.0, 210.0], [0.0, 210.0]]
"""A side is seven steps of the lattice: many points are equally near, and some lie on the
boundary."""
RAGGED = [[-33.42, -140.43], [-129.57, -16.79], [-60.0, 20.0], [-100.17, 108.35], [146.39, -17.27]]


def simulation(vertices, offset):
    """Worlds with given places, moved by an offset [m]."""

    def moved(*places):
        return (np.array(places) + offset).tolist()

    starts = moved([0.5, 11.0], [30.25, 30.0], [61.0, 3.0])
    region = RegionConfig(
        "vertices", vertices=moved(*vertices), start_positions=starts, initial_conditions=1
    )
    source = SourceConfig(motion="dynamic", position=moved([30.0, 20.7])[0])
    battery = BatteryConfig(enabled=True, charging_points=moved([9.0, 9.0], [70, 8.5]))
    return Simulation(
        WorldConfig(
            region=region,
            source=source,
            battery=battery,
        ),
        1.0,
        stops=2,
        seed=0,
    )


@pytest.mark.parametrize(
    ("vertices", "offset"),
    [
        (SQUARE, (1000.0, 1000.0)),
        (RAGGED, (-9_876_543.21, 0.1)),
    ],
)
def test_moving_the_region_and_all_places_changes_no_bit_of_what_a_step_reads(vertices, offset):
    worlds = before, after = simulation(vertices, (0.0, 0.0)), simulation(vertices, offset)
    trees = zip(
        *((w.packed_initial, w.walks[0], w.candidates.ranking, w.airspace.cells) for w in worlds),
        strict=True,
    )
    assert all(one.equal(other) for pair in trees for one, other in zip(*pair, strict=True))
    assert before.vehicles.chargers.equal(after.vehicles.chargers)
    moved = after.airspace.offset - before.airspace.offset
    np.testing.assert_allclose(moved[0], offset, rtol=1e-6, atol=0.1)
