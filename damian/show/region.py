"""Draws the region of a training, so that a user can check the map that was read."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from damian.common.plotting import save_figure
from damian.show.views import draw_region
from damian.world.simulation import Simulation


def save_region(simulation: Simulation, path: Path) -> str:
    """Draw the region with its no-fly zones, landing points and a footprint to scale.

    Returns a line with its area, its landing points and how many footprints it has room for, and a
    warning if these are fewer than the UAVs, or more than a hundred times as many.
    """
    region = simulation.airspace.regions[0]
    area = region.polygon.area
    points = simulation.airspace.exact_points[0]
    points = points[points.isfinite().all(-1)].numpy()
    radius = simulation.radius
    agents = simulation.config.agents
    fitting = area / (np.pi * radius**2)
    told = f"{region.name}: {area / 1e6:.3g} km², {len(points)} landing points, "
    told += f"room for {fitting:.3g} footprints of {radius:.3g} m"
    figure = Figure(layout="constrained")
    axis = figure.subplots()
    draw_region(axis, region.polygon, points, radius)
    axis.add_patch(Circle(points[len(points) // 2], radius, alpha=0.4, zorder=2))
    axis.set_title(told, loc="left", fontsize=8)
    save_figure(figure, path, dpi=150)
    fits = agents <= fitting <= 100 * agents
    warning = f"\nwarning: footprints do not fit agents={agents}; source.level_db sets them"
    return f"region: {path} ({told}){'' if fits else warning}"
