"""The regions of a world, with their landing points, as its settings say."""

import numpy as np

from damian.settings.world import WorldConfig
from damian.world.airspace import Airspace, build_airspace
from damian.world.regions.config import regions_of


def airspace_of(config: WorldConfig, rng: np.random.Generator) -> Airspace:
    """Build the regions and their landing points.

    Args:
        config: settings of the world.
        rng: random generator, for random regions.

    Raises:
        InputError: a wrong file or polygon, or fewer landing points than UAVs.
    """
    region = config.region
    return build_airspace(
        regions_of(region, rng),
        region.lattice_step,
        region.lattice_angle,
        region.n_landing_points,
        config.agents,
    )
