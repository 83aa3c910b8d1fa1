"""The region of a run as a picture, so that one sees what was read of a map."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from damian.common.plotting import COLOURS, save_figure
from damian.show.views import draw_region
from damian.world.config import WorldConfig
from damian.world.regions.polygon import landing_lattice
from damian.world.regions.sources import regions_of
from damian.world.signal_source import footprint_radius

MANY = 100
"""Number of footprints for each UAV from which on a region is too large for them."""


def save_region(config: WorldConfig, seed: int, path: Path) -> list[str]:
    """Draw the region with its no-fly zones, landing points and a footprint to scale; returns lines
    that say what it is, and whether the footprints do not fit it."""
    found = config.region
    region = regions_of(found, np.random.default_rng(seed))[0]
    polygon = region.polygon
    points = landing_lattice(
        polygon, found.lattice_step, found.lattice_angle, found.n_landing_points
    )
    radius = footprint_radius(config.source)
    figure = Figure(figsize=(5, 5), layout="constrained")
    axis = figure.subplots()
    draw_region(axis, polygon, points, radius)
    middle = np.hypot(*(points - points.mean(0)).T).argmin()
    axis.add_patch(Circle(points[middle], radius, alpha=0.4, color=COLOURS[0], zorder=2))
    told = f"{region.name}, {polygon.area / 1e6:.3g} km², {len(points)} landing points"
    axis.set_title(f"{told},\na footprint of {radius:.3g} m", loc="left", fontsize=9)
    save_figure(figure, path, dpi=150)
    fitting = polygon.area / (np.pi * radius**2)
    lines = [f"region: {path} ({told})"]
    if not config.agents <= fitting <= MANY * config.agents:
        size = "large" if fitting < config.agents else "small"
        lines.append(
            f"warning: footprints of {radius:.3g} m are {size} for this region: about {fitting:.2g} "
            f"fill it, and agents={config.agents}; source.level_db sets their radius"
        )
    return lines
