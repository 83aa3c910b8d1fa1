"""Your own region source: an L-shaped yard.

    cd examples/extending
    damian train region=vertices region.kind=region:yard "region.options={side: 300}"

A source is a function from the settings and a random generator to regions; polygons are in local
metres, x east, y north. It may return several regions, of which each episode flies over one.
"""

import numpy as np
import shapely

from damian.common import checks
from damian.world.regions.region import Region
from damian.world.regions.sources import RegionConfig


def yard(config: RegionConfig, rng: np.random.Generator) -> list[Region]:
    """An L whose outer sides are ``side`` metres long, at the origin."""
    options = config.options or {}
    for name in options:
        checks.one_of("region.options", name, ["side"])
    side = options.get("side", 300.0)
    checks.above("region.options.side", side, 0.0, "m")
    square = shapely.box(-side / 2, -side / 2, side / 2, side / 2)
    return [Region(square.difference(shapely.box(0, 0, side, side)), "L-shaped yard")]
