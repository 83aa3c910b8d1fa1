"""One instant of an episode, as every picture of it shows it."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from damian.common.plotting import COLOURS, UAV_COLOURS
from damian.show.episode import LIKELY, Episode, Floats

TRAIL, HOPS = 8, 3
"""Number of steps whose path is drawn behind a UAV, and behind one that is at once where it flies."""
INK = "#222222"
"""Colour of texts, and of messages that are lost."""
LATENESS = ("#a3b1bb", "#e08a00", "#7a0019")
"""Colours of delays: none, medium, and the longest."""


@dataclass(frozen=True)
class Uav:
    """A UAV at an instant."""

    id: str
    chosen: bool
    """Whether the picture tells it apart: by its name, its colour, its path and what is believed of
    it."""
    colour: str
    ink: str
    """The colour of its texts, which is dark."""
    edge: str
    """The colour of its marks' edges, which tells it from an earlier one of the same colour."""
    path: Floats
    """Its latest places, the present one last: east, north, up [m], [P, 3]."""
    heading: float
    """Clockwise from north [rad]."""
    spots: bool
    """Whether it spots the source."""
    believed: Floats
    """Where the server believes it to be: east, north [m], [2]."""
    age: float
    """Age of the message from which the server knows that [s]."""


@dataclass(frozen=True)
class Frame:
    """What is true at an instant, and what the server believes."""

    step: int
    time: float
    """Time since the reset [s]."""
    uavs: list[Uav]
    sources: list[tuple[Floats, bool]]
    """Place of each source, east, north [m], [2], and whether it emits; none if nobody knows
    them."""
    requests: Floats
    """Places of open requests, east, north [m], [M, 2]."""
    cells: list[tuple[Any, float]]
    """Where a source may well be: polygons or several of them, with the probability that any is
    there."""


def chosen_of(episode: Episode, shown: Collection[str]) -> list[int]:
    """Numbers of the UAVs that a picture tells apart: those with these IDs, else all of few."""
    found = [uav for uav, name in enumerate(episode.ids) if name in shown]
    return found or [*range(episode.n_agents if episode.n_agents <= len(COLOURS) else 0)]


def frame_of(episode: Episode, step: int, chosen: Collection[int] | None = None) -> Frame:
    """An episode after ``step`` steps, with the numbers of the UAVs to tell apart, or all."""
    begin = max(step - (HOPS if episode.instant else TRAIL), 0)
    rank = {
        uav: place
        for place, uav in enumerate(range(episode.n_agents) if chosen is None else chosen)
    }
    known = episode.source
    emits = episode.emits
    asked = episode.requests
    belief = [] if episode.belief is None else 1 - (1 - episode.belief[step]).prod(0)
    uavs = [
        Uav(
            id=episode.ids[uav],
            chosen=uav in rank,
            colour=UAV_COLOURS[rank.get(uav, 0) % len(UAV_COLOURS)],
            ink=UAV_COLOURS[len(COLOURS) + rank.get(uav, 0) % len(COLOURS)],
            edge=("white", INK)[rank.get(uav, 0) // len(UAV_COLOURS) % 2],
            path=episode.position[begin : step + 1, uav],
            heading=float(episode.track[step, uav]),
            spots=bool(episode.spotted[step, uav]),
            believed=episode.believed[step, uav],
            age=float(episode.age[step, uav]),
        )
        for uav in range(episode.n_agents)
    ]
    return Frame(
        step=step,
        time=float(episode.time[step]),
        uavs=uavs,
        sources=[]
        if known is None or emits is None
        else [*zip(known[step], emits[step], strict=True)],
        requests=np.zeros((0, 2)) if asked is None else asked[step][asked[step][:, 2] > 0, :2],
        cells=[
            (area, float(p)) for area, p in zip(episode.squares, belief, strict=True) if p > LIKELY
        ],
    )


def limits(region: Any, radius: float) -> tuple[Floats, Floats]:
    """Lower left and upper right corner of what a view of a region shows, with room for footprints,
    east and north [m]."""
    west, south, east, north = region.bounds
    margin = max(0.06 * max(east - west, north - south), 0.5 * radius)
    return np.array([west, south]) - margin, np.array([east, north]) + margin
