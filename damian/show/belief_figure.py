"""Figure of one flight: where the server believed the UAVs to be, beside where they truly were."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from damian.common.plotting import COLOURS, STYLE
from damian.show.episode import Episode, Floats
from damian.show.frame import frame_of
from damian.show.views import INK, MapView, draw_messages, legend_marks

_LARGE = 4
"""The map leaves out the border of a region that is more than this many times as large as the paths in it."""
_DASHES = ("-", "--", ":", "-.")
"""Lines of the UAVs: the first for as many as there are colours, and so on."""


def plot_beliefs(flight: Episode, path: Path) -> None:
    """Draw a map at the instant when the server was most mistaken; errors, ages and messages over time."""
    error = np.linalg.norm(flight.true - flight.believed, axis=-1)
    worst = int(np.flatnonzero(error.sum(-1) == error.sum(-1).max())[-1])
    frame = frame_of(flight, worst, trail=None)
    rows = min(flight.n_agents, 20) * 0.22 + 0.2
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.0, 6.6 + rows), layout="constrained")
        axes = figure.subplots(4, 1, height_ratios=[3.6, 1.0, 1.0, rows])
        MapView(axes[0], flight).draw(frame)
        source = [] if flight.source is None else [flight.source]
        paths = np.concatenate([flight.true.reshape(-1, 2), flight.believed.reshape(-1, 2), *source])
        region = np.reshape(flight.region.bounds, (2, 2))
        if np.ptp(region, axis=0).max() > _LARGE * (np.ptp(paths, axis=0).max() + 2 * flight.radius):
            low, high = paths.min(0) - flight.radius, paths.max(0) + flight.radius
            axes[0].set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        reason = ", when the server is most mistaken" if error.any() else ""
        axes[0].set_title(f"paths, and the UAVs at {frame.time:g} s{reason}", fontsize="medium")
        marks = [*legend_marks(flight), *_lines(axes[1], flight, error)]
        axes[0].legend(handles=marks, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        axes[1].set_ylabel("error of the\nposition [m]")
        _lines(axes[2], flight, flight.age)
        axes[2].set_ylabel("age of\nmessage [s]")
        axes[2].set_title(f"mean age {flight.age.mean():.2f} s", fontsize="medium")
        draw_messages(axes[3], flight, [uav.colour for uav in frame.uavs])
        for axis in axes[1:]:
            axis.axvline(frame.time, color=INK, linewidth=0.8, linestyle=":")
            axis.set_xlim(axes[3].get_xlim())
        figure.savefig(path, dpi=200)


def _lines(axis: Axes, flight: Episode, values: Floats) -> list[Any]:
    """Draw a value of each UAV over time, [T + 1, N]; returns the lines."""
    lines = []
    for uav, shown in enumerate(frame_of(flight, 0).uavs):
        style: dict[str, Any] = {"color": shown.colour, "label": shown.name, "linewidth": 1.2}
        dashes = _DASHES[uav // len(COLOURS) % len(_DASHES)]
        lines += axis.step(flight.time, values[:, uav], linestyle=dashes, where="post", **style)
    axis.set_ylim(0, 1.1 * float(values.max()) or 1.0)
    return lines[: len(_DASHES) * len(COLOURS)]
