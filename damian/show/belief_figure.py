"""Figure of one flight: where the server believed the UAVs to be, beside where they truly were."""

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from damian.common.plotting import STYLE
from damian.show.episode import Episode, Floats
from damian.show.frame import INK, frame_of
from damian.show.views import MapView, draw_messages, draw_scale, height_of_rows, legend_marks, name_rows

_LARGE = 4
"""The map leaves out the border of a region that is more than this many times as large as the paths in it."""


def plot_beliefs(flight: Episode, path: Path) -> None:
    """Draw a map at the instant when the server was most mistaken; errors, ages and messages over time."""
    error = np.linalg.norm(flight.true - flight.believed, axis=-1)
    worst = int(np.flatnonzero(error.sum(-1) == error.sum(-1).max())[-1])
    frame, rows = frame_of(flight, worst, trail=None), height_of_rows(flight.n_agents)
    chart = rows if flight.is_crowded else 1.0
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.0, 4.6 + 2 * chart + rows), layout="constrained")
        axes = figure.subplots(4, 1, height_ratios=[3.6, chart, chart, rows])
        view = MapView(axes[0], flight)
        source = [] if flight.source is None else [flight.source.reshape(-1, 2)]
        paths = np.concatenate([flight.true.reshape(-1, 2), flight.believed.reshape(-1, 2), *source])
        region = np.reshape(flight.region.bounds, (2, 2))
        if np.ptp(region, axis=0).max() > _LARGE * (np.ptp(paths, axis=0).max() + 2 * flight.radius):
            low, high = paths.min(0) - flight.radius, paths.max(0) + flight.radius
            axes[0].set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        reason = ", when the server is most mistaken" if error.any() else ""
        if flight.belief is not None:
            reason += f"; belief {flight.entropy(worst):.1f} bit"
            draw_scale(axes[0].inset_axes((1.05, 0.05, 0.45, 0.03)))
        axes[0].set_title(f"{frame.time:g} s{reason}", fontsize="medium")
        _draw_values(axes[1], flight, error, "error of the position [m]")
        _draw_values(axes[2], flight, flight.age, f"age of the message [s], mean {flight.age.mean():.2f} s")
        place = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0), "frameon": False}
        axes[0].legend(handles=[*legend_marks(flight), *axes[1].lines], **place)
        draw_messages(axes[3], flight, [uav.colour for uav in frame.uavs])
        for axis in axes[1:]:
            axis.axvline(frame.time, color=INK, linewidth=0.8, linestyle=":")
            axis.set_xlim(axes[3].get_xlim())
        figure.draw_without_rendering()  # names need places for their marks
        view.draw(frame)
        figure.savefig(path, dpi=200)


def _draw_values(axis: Axes, flight: Episode, values: Floats, title: str) -> None:
    """Draw a value of each UAV over time, [T + 1, N], as lines; of many as rows, which hide nothing."""
    axis.set_title(title, loc="left", fontsize="medium")
    if flight.is_crowded:
        rows = np.arange(flight.n_agents + 1) - 0.5
        picture = axis.pcolormesh(flight.time, rows, values[:-1].T, cmap="magma_r")
        axis.figure.colorbar(picture, ax=axis, pad=0.01)
        axis.invert_yaxis()
        name_rows(axis, flight)
        return
    for line, uav, name in zip(values.T, frame_of(flight, 0).uavs, flight.names, strict=True):
        axis.step(flight.time, line, color=uav.colour, label=name, where="post", linewidth=1.2)
    axis.set_ylim(0, 1.1 * float(values.max()) or 1.0)
