"""Films of an episode: what is true, what the server believes, and the messages between them."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.animation import FFMpegWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator
from PIL import Image

from damian.common import checks
from damian.show.belief_figure import COLOURS
from damian.show.episode import Episode
from damian.show.film_views import DART, HEAT, INK, MapView, SpaceView

VIEWS = ("2d", "3d")
DPI = 100
SIZE = (7.2, 7.0)
"""Width and height of a film [inches]."""
STEPS_PER_SECOND = 4
"""Steps that a film shows in a second."""
LONGEST_GIF = 1000
"""Most steps of a GIF, all of whose pictures (half a megabyte each) are in memory until it is written."""
LAST_STEPS = 6
"""Steps for whose time a film shows the last instant."""
_STYLE: dict[Any, Any] = {"font.size": 8.5, "axes.spines.top": False, "axes.spines.right": False}


def save_film(episode: Episode, path: Path, view: str = "2d") -> None:
    """Write a film of an episode: a GIF if the path ends so, else what ffmpeg makes of the path.

    Raises:
        InputError: there is no such view, or the episode is too long for a GIF.
    """
    if path.suffix == ".gif":
        check_gif(episode)
    film, steps = Film(episode, view), range(episode.n_steps + 1)
    if path.suffix != ".gif":
        writer = FFMpegWriter(STEPS_PER_SECOND)
        with writer.saving(film.figure, str(path), DPI):
            for step in [*steps, *[episode.n_steps] * LAST_STEPS]:
                film.draw(step)
                writer.grab_frame()
        return
    first, *others = [film.image(step) for step in steps]
    times = [1000 // STEPS_PER_SECOND] * episode.n_steps + [1000 * LAST_STEPS // STEPS_PER_SECOND]
    first.save(path, save_all=True, append_images=others, duration=times, loop=0)


def check_gif(episode: Episode) -> None:
    """Refuse an episode that is too long for a GIF.

    Raises:
        InputError: it has more than ``LONGEST_GIF`` steps.
    """
    should = f"steps are more than {LONGEST_GIF}, the most of a gif: choose mp4 or html, or a shorter episode"
    checks.require(episode.n_steps <= LONGEST_GIF, "formats", episode.n_steps, should)


class Film:
    """Draws the instants of an episode, one at a time, into the same figure.

    The view shows the region with its landing points, the UAVs with their paths and footprints (stronger
    while they spot the source), the source (filled while it emits), where the server believes the UAVs to be
    (rings, with the age of what it knows), and, if there is one, its belief about the source. Below: a row
    for each UAV with every message, from the time at which it was sent until it arrives.

    Args:
        episode: the episode to draw.
        view: ``2d``: from above; ``3d``: with the space above it.

    Raises:
        InputError: there is no such view.
    """

    def __init__(self, episode: Episode, view: str = "2d") -> None:
        checks.one_of("view", view, VIEWS)
        self.episode = episode
        self.colours = [COLOURS[uav % len(COLOURS)] for uav in range(episode.n_agents)]
        with matplotlib.rc_context(_STYLE):
            self.figure = Figure(figsize=SIZE, dpi=DPI)
            FigureCanvasAgg(self.figure)
            heights = [2.5, 1.1, 1.1, min(episode.n_agents, 8) * 0.22 + 0.2]
            sides = {"left": 0.085, "right": 0.975, "top": 0.945, "bottom": 0.075}
            space = {"hspace": 0.5, "wspace": 0.16}
            grid = self.figure.add_gridspec(
                4, 2, height_ratios=heights, width_ratios=[3.1, 1], **sides, **space
            )
            self.map = self.figure.add_subplot(grid[:3, 0], projection="3d" if view == "3d" else None)
            self.charts = [self.figure.add_subplot(grid[row, 1]) for row in (1, 2)]
            self.lanes = self.figure.add_subplot(grid[3, :])
            self.view = (SpaceView if view == "3d" else MapView)(self.map, episode, self.colours)
            self._draw_legend()
            self._draw_charts()
            self._draw_messages()
        self._moving: list[Any] = []

    def draw(self, step: int) -> list[Any]:
        """Draw the instant after so many steps; returns the artists that were drawn."""
        for artist in self._moving:
            artist.remove()
        now, spotted = float(self.episode.time[step]), int(self.episode.spotted[step].sum())
        with matplotlib.rc_context(_STYLE):
            self._moving = [*self.view.draw(step), *self._now(now)]
        won = f"return {self.episode.reward[: step + 1].mean(-1).sum():.2f}"
        spots = f"{spotted} of {self.episode.n_agents} UAVs spot the source"
        self.figure.suptitle(f"{now:g} s   ·   {won}   ·   {spots}", x=0.085, ha="left", fontsize=10)
        return self._moving

    def frame(self, step: int) -> np.ndarray:
        """The picture of an instant, [height, width, 3] uint8."""
        self.draw(step)
        canvas: Any = self.figure.canvas
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    def image(self, step: int) -> Image.Image:
        """The picture of an instant in 256 colours, which is a third of its size."""
        return Image.fromarray(self.frame(step)).quantize(dither=Image.Dither.NONE)

    def _draw_legend(self) -> None:
        marks: list[Any] = [
            _mark("UAV, true", marker=DART, markersize=9),
            _mark("UAV, as the server\nbelieves, with age", marker="o", markerfacecolor="none", markersize=9),
        ]
        if self.episode.source is not None:
            white = {"markerfacecolor": "white"}
            marks += [
                _mark(f"source, {does}", marker="*", color=INK, markersize=11, **style)
                for does, style in (("emits", {}), ("silent", white))
            ]
        if self.episode.belief is not None:
            marks.append(Rectangle((0, 0), 1, 1, facecolor=HEAT(1.0), label="belief about\nthe source"))
        self.figure.legend(handles=marks, loc="upper left", bbox_to_anchor=(0.745, 0.95), frameon=False)

    def _draw_charts(self) -> None:
        """Draw over time the return so far and the age of what the server knows, or the batteries if used."""
        episode = self.episode
        used = not np.allclose(episode.battery, episode.battery[:1])
        titles = ("return so far", "battery [%]" if used else "age of information [s]")
        self.charts[0].plot(episode.time, episode.reward.mean(-1).cumsum(), color=INK, linewidth=1.3)
        for uav, colour in enumerate(self.colours):
            values = episode.battery[:, uav] if used else episode.age[:, uav]
            style = "default" if used else "steps-post"
            self.charts[1].plot(episode.time, values, color=colour, linewidth=1.2, drawstyle=style)
        for axis, title in zip(self.charts, titles, strict=True):
            axis.set_title(title, loc="left", fontsize=8.5)
            axis.margins(x=0)
            axis.yaxis.set_major_locator(MaxNLocator(3))
            axis.xaxis.set_major_locator(MaxNLocator(3))

    def _now(self, time: float) -> list[Any]:
        """Mark a time in the charts, and cover what comes after it."""
        drawn = []
        for axis in (self.lanes, *self.charts):
            end = axis.get_xlim()[1]
            drawn.append(axis.axvspan(time, end, facecolor="white", alpha=0.65, linewidth=0, zorder=8))
            drawn.append(axis.axvline(time, color=INK, linewidth=0.9, zorder=9))
        return drawn

    def _draw_messages(self) -> None:
        """Draw a row for each UAV with its messages, from left to right over the time of sending."""
        axis, episode = self.lanes, self.episode
        dt = float(episode.time[1] - episode.time[0]) if episode.n_steps else 1.0
        for uav, colour in enumerate(self.colours):
            sent = np.flatnonzero(episode.sent[:, uav])
            begin, delay = episode.time[sent], episode.delay[sent, uav]
            late, lost = delay > 0, delay < 0
            ends = np.stack([begin, begin + np.maximum(delay, 0) * dt], -1)[late]
            lines = [[(a, uav), (b, uav)] for a, b in ends]
            axis.add_collection(LineCollection(lines, colors=colour, linewidths=2.2, alpha=0.55))
            axis.plot(
                begin[~lost & ~late], np.full((~lost & ~late).sum(), uav), ".", color=colour, markersize=3
            )
            axis.plot(ends[:, 1], np.full(len(ends), uav), ">", color=colour, markersize=3.5)
            axis.plot(begin[lost], np.full(lost.sum(), uav), "x", color=INK, markersize=4.5)
        axis.set_yticks(range(episode.n_agents), [_short(name) for name in episode.names])
        axis.set(ylim=(episode.n_agents - 0.4, -0.6), xlim=(0, max(float(episode.time[-1]), dt)))
        axis.set_xlabel("messages over time [s]: dots arrive at once, bars are late, crosses are lost")
        axis.spines["left"].set_visible(False)
        axis.tick_params(left=False)


def _short(name: str) -> str:
    """A name that fits beside its row."""
    return name if len(name) <= 8 else f"{name[:7]}\N{HORIZONTAL ELLIPSIS}"


def _mark(label: str, color: str = "0.3", **style: Any) -> Line2D:
    """An entry of the legend."""
    return Line2D([], [], label=label, color=color, linestyle="", **style)
