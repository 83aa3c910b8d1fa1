"""The region of a run as a picture, so that one sees what was read of a map."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from damian.common.plotting import save_figure
from damian.show.views import draw_region
from damian.world.config import WorldConfig
from damian.world.regions.polygon import landing_lattice
from damian.world.regions.sources import regions_of
from damian.world.signal_source import footprint_radius


def save_region(config: WorldConfig, seed: int, path: Path) -> str:
    """Draw the region with its no-fly zones, landing points and a footprint to scale; returns a
    line that says what it is, and a warning if the footprints do not fit it."""
    of = config.region
    region = regions_of(of, np.random.default_rng(seed))[0]
    area = region.polygon.area
    points = landing_lattice(region.polygon, of.lattice_step, of.lattice_angle, of.n_landing_points)
    radius = footprint_radius(config.source)
    fitting = area / (np.pi * radius**2)
    told = f"{region.name}: {area / 1e6:.3g} km², {len(points)} landing points, "
    told += f"room for {fitting:.3g} footprints of {radius:.3g} m"
    figure = Figure(layout="constrained")
    axis = figure.subplots()
    draw_region(axis, region.polygon, points, radius)
    axis.add_patch(Circle(points[len(points) // 2], radius, alpha=0.4, zorder=2))
    axis.set_title(told, loc="left", fontsize=8)
    save_figure(figure, path, dpi=150)
    fits = config.agents <= fitting <= 100 * config.agents
    warning = f"\nwarning: footprints do not fit agents={config.agents}; source.level_db sets them"
    return f"region: {path} ({told}){'' if fits else warning}"
