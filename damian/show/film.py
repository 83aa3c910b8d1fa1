"""Films of an episode: what is true, what the server believes, and the messages between them."""

import io
from collections.abc import Collection
from pathlib import Path
from typing import Any, cast

import matplotlib
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from PIL import Image
from tensordict import TensorDictBase

from damian.common.atomic_files import write_atomically
from damian.common.plotting import STYLE, save_figure
from damian.envs.uav_env import UavEnv
from damian.show.episode import Episode, at_instant, episode_of
from damian.show.frame import INK, chosen_of, frame_of, limits
from damian.show.views import LATE, ROWS, MapView, draw_messages, lateness, legend_marks

DPI = 100
WIDTH, MAP, FLAT = 7.2, 4.6, 0.65
"""Width of a film, longest side of its map [inches], and height over width of a map that is flat."""
STEPS_PER_SECOND = 4
"""Steps that a film shows in a second."""
LAST_STEPS = 6
"""Steps for whose time a film shows the last instant."""
_STYLE: dict = {**STYLE, "font.size": 8.5, "lines.linewidth": 1.2}


def save_film(episode: Episode, path: Path, shown: Collection[str] = ()) -> None:
    """Write a film of an episode as a GIF."""
    film = Film(episode, shown)
    steps = range(episode.n_steps + 1)
    pictures = (Image.fromarray(film.frame(step)) for step in steps)
    kept = {
        "method": Image.Quantize.MAXCOVERAGE,
        "dither": Image.Dither.NONE,
    }  # not the mean of like colours
    first, *others = [each.quantize(**kept) for each in pictures]  # a third of the size
    times = [1000 // STEPS_PER_SECOND] * episode.n_steps + [1000 * LAST_STEPS // STEPS_PER_SECOND]
    content = io.BytesIO()
    first.save(content, "GIF", save_all=True, append_images=others, duration=times, loop=0)
    write_atomically(path, content.getvalue())


def save_picture(episode: Episode, path: Path, shown: Collection[str]) -> None:
    """Write the picture of the instant at which the server was most mistaken about where the UAVs
    were."""
    error = np.linalg.norm(episode.true - episode.believed, axis=-1).sum(-1)
    film = Film(episode, shown)
    film.draw(int(np.flatnonzero(error == error.max())[-1]))
    save_figure(film.figure, path, dpi=2 * DPI)


class Film:
    """Draws the instants of an episode into one figure.

    ``shown`` are the IDs of the UAVs to tell apart; if there are none, all of up to six.
    """

    def __init__(self, episode: Episode, shown: Collection[str] = ()) -> None:
        self.episode = episode
        self.chosen = chosen_of(episode, shown)
        uavs = frame_of(episode, 0, self.chosen).uavs
        self.colours = {uav: uavs[uav].colour for uav in self.chosen}
        with matplotlib.rc_context(_STYLE):
            corner, end = limits(episode.region, episode.radius)
            aspect = np.divide(*(end - corner)[::-1])
            flat = aspect < FLAT  # then the charts have room below the map
            wide = min(MAP, MAP / aspect)
            rows = 0.3 + 0.15 * (max(episode.n_agents, 4) if episode.n_agents <= ROWS else 8)
            low = rows + (2.4 if flat else 1.0)
            high = max(wide * aspect, 2.2 if flat else 3.6)
            left = 0.65 + wide + 0.4
            size = (WIDTH, round(low + high + 0.4, 1))
            self.figure = Figure(figsize=size, dpi=DPI)
            FigureCanvasAgg(self.figure)

            def axes(*place: float) -> Any:
                return self.figure.add_axes(tuple(np.divide(place, size * 2)))

            self.view = MapView(axes(0.65, low, wide, high), episode)
            self.charts = [
                axes(*((at, rows + 1, 2.9, 0.7) if flat else (left, low + up, 7 - left, 0.7)))
                for at, up in ((0.65, 1.3), (4.1, 0))
            ]
            self.lanes = axes(0.65, 0.5, 6.35, rows)
            top = ((left - 0.15) / size[0], (low + high) / size[1])
            legend = self.figure.legend(
                handles=legend_marks(episode),
                loc="upper left",
                bbox_to_anchor=top,
                frameon=False,
                labelspacing=0.3,
            )
            self._draw_charts()
            draw_messages(self.lanes, episode, self.colours)
            self.figure.colorbar(
                ScalarMappable(lateness(episode), LATE),
                axes(left, legend.get_window_extent().y0 / DPI - 0.2, 1.4, 0.1),
                orientation="horizontal",
                label="late by, or age [s]",
                ticks=MaxNLocator(4, integer=True),
            )
        self._moving: list = []

    def draw(self, step: int) -> list:
        """Draw the instant after so many steps; returns the artists that were drawn."""
        for artist in self._moving:
            artist.remove()
        frame = frame_of(self.episode, step, self.chosen)
        with matplotlib.rc_context(_STYLE):
            self._moving = [*self.view.draw(frame), *self._now(frame.time)]
        told = [f"{frame.time:g} s", f"return {self.episode.reward[: step + 1].mean(-1).sum():.2f}"]
        if self.episode.has_source:
            which = "a" if len(frame.sources) > 1 else "the"
            n_spotting = sum(uav.spots for uav in frame.uavs)
            told.append(f"{n_spotting} of {len(frame.uavs)} UAVs spot {which} source")
        if self.episode.belief is not None:
            told.append(f"belief {self.episode.entropy(step):.1f} bit")
        self.figure.suptitle("   ·   ".join(told), x=0.085, ha="left", fontsize=10)
        return self._moving

    def frame(self, step: int) -> NDArray[np.uint8]:
        """The picture of an instant, [height, width, 3] uint8."""
        self.draw(step)
        canvas: Any = self.figure.canvas
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    def _draw_charts(self) -> None:
        """Draw over time the return so far, and the ages of messages, or the batteries if they are
        used."""
        episode = self.episode
        used = not np.allclose(episode.battery, episode.battery[:1])
        title = "battery [%]" if used else "age of information [s]"
        values = episode.battery if used else episode.age
        drawstyle = "default" if used else "steps-post"
        self.charts[0].plot(episode.time, episode.reward.mean(-1).cumsum(), color=INK)
        lines = self.charts[1].plot(episode.time, values, color="0.85", drawstyle=drawstyle)
        if not self.colours:
            self.charts[1].plot(episode.time, values.mean(-1), color=INK)
        for uav, colour in self.colours.items():
            lines[uav].set(color=colour, zorder=3)
        for axis, above in zip(self.charts, ("return so far", title), strict=True):
            axis.set_title(above, loc="left", fontsize=8.5)
            axis.margins(x=0)
            axis.locator_params(nbins=3)

    def _now(self, time: float) -> list:
        """Mark a time in the charts, and cover what comes after it."""
        drawn = []
        for axis in (self.lanes, *self.charts):
            end = axis.get_xlim()[1]
            drawn.append(
                axis.axvspan(time, end, facecolor="white", alpha=0.65, linewidth=0, zorder=8)
            )
            drawn.append(axis.axvline(time, color=INK, linewidth=0.9, zorder=9))
        return drawn


class LiveFilm:
    """Draws an episode while it is flown, in about 0.3 s an instant.

    The environment, of one world, has the extras ``message``, ``state`` and ``reward_terms``.
    """

    def __init__(self, env: UavEnv) -> None:
        self.env = env
        self._instants: list[TensorDictBase] = []

    def reset(self, outputs: TensorDictBase) -> None:
        """Begin an episode, with the outputs of a reset, [1]."""
        self._instants = [at_instant(outputs).detach().cpu()]

    def add(self, outputs: TensorDictBase) -> None:
        """Add the outputs of a step, [1]."""
        self._instants.append(at_instant(outputs).detach().cpu())

    def picture(self) -> NDArray[np.uint8]:
        """The latest instant, as a film of the episode so far shows it, [height, width, 3]."""
        stacked = cast(TensorDictBase, torch.stack([each[0] for each in self._instants]))  # type: ignore[arg-type]
        episode = episode_of(stacked, self.env, {})
        return Film(episode).frame(episode.n_steps)
