"""One flown episode as data: the truth, the messages with their delays, and what the server
believed.

Films, figures and replay pages are made from it. As a file it is JSON that says itself what its
columns mean.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import shapely
import torch
from numpy.typing import NDArray
from shapely.errors import ShapelyError
from tensordict import TensorDictBase
from torch import Tensor

import damian
from damian import keys
from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError
from damian.common.text_files import named, one_line, read_text
from damian.envs.uav_env import UavEnv
from damian.world.signal_source import footprint_radius
from damian.world.state import Truth

SCHEMA = "damian-episode"
VERSION = 3
DIGITS = 5
"""Significant digits of the numbers in a file."""
TIME_DIGITS = 9
"""Those of times, which must differ from step to step in long episodes too."""

LIKELY = 1e-4
"""Smallest probability of a cell worth showing; colours are on a logarithmic scale from it to 1."""

Floats = NDArray[np.floating]
Flags = NDArray[np.bool_]
Integers = NDArray[np.integer]


@dataclass(frozen=True)
class Episode:
    """One episode of N UAVs over T steps, at T + 1 instants: the reset, and the end of each
    step."""

    about: Mapping[str, Any]
    """Where it comes from: version, policy, seed, and what else the program knows."""
    region: shapely.Polygon | shapely.MultiPolygon
    """Region in which the UAVs fly, east and north [m]."""
    origin: tuple[float, float] | None
    """Latitude and longitude of the point (0, 0) [deg]; None for a region without a place on
    Earth."""
    landing_points: Floats
    """Points on which UAVs land, east and north [m], [P, 2]."""
    radius: float
    """Radius of the footprint, within which a UAV hears the source [m]."""
    instant: bool
    """Whether a UAV reaches its target by the end of the step (motion ``instant``)."""
    success: bool
    """Whether the episode ended with success."""
    time: Annotated[Floats, "time of each instant [s], [T + 1]"]
    position: Annotated[Floats, "true positions: east, north, up [m], [T + 1, N, 3]"]
    target: Annotated[
        Floats, "landing points to which the UAVs fly: east, north [m], [T + 1, N, 2]"
    ]
    track: Annotated[Floats, "headings, clockwise from north [rad], [T + 1, N]"]
    battery: Annotated[Floats, "battery levels [%], [T + 1, N]"]
    spotted: Annotated[Flags, "whether the UAV spots a source, [T + 1, N]"]
    source: Annotated[
        Floats | None,
        "positions of the sources, none if the task has none: east, north [m]; null if nobody "
        "knows them, [T + 1, K, 2]",
    ]
    emits: Annotated[Flags | None, "whether each source emits; null if nobody knows it, [T + 1, K]"]
    sent: Annotated[
        Flags, "whether the UAV sent a message in the step; not at the reset, [T + 1, N]"
    ]
    delay: Annotated[
        Integers, "delay of that message [steps], negative if it never arrives, [T + 1, N]"
    ]
    believed: Annotated[Floats, "positions in the messages that the server held [m], [T + 1, N, 2]"]
    age: Annotated[Floats, "ages of these messages [s], [T + 1, N]"]
    reward: Annotated[Floats, "rewards of the step, as the server perceived them, [T + 1, N]"]
    reward_terms: Annotated[
        Mapping[str, Floats], "their weighted terms by name, each [T + 1, N]"
    ] = field(default_factory=dict)
    cells: Annotated[Floats | None, "centres of the belief's cells: east, north [m], [C, 2]"] = None
    belief: Annotated[Floats | None, "probability that each source is in a cell, [T + 1, K, C]"] = (
        None
    )
    requests: Annotated[
        Floats | None,
        "latest requests: east, north [m], 1 while it is open; null if there are none, [T + 1, M, "
        "3]",
    ] = None

    @property
    def n_agents(self) -> int:
        """Number of UAVs, N."""
        return self.position.shape[1]

    @property
    def ids(self) -> list[str]:
        """The UAVs on a map: their IDs if they are real ones, else their numbers."""
        ids = self.about.get("uavs")
        known = isinstance(ids, list) and len(ids) == self.n_agents
        return [str(cast(list, ids)[uav] if known else uav) for uav in range(self.n_agents)]

    @property
    def names(self) -> list[str]:
        """The UAVs in a text: their IDs if they are real ones, else as in ``UAV 0``."""
        return self.ids if self.about.get("uavs") else [f"UAV {uav}" for uav in self.ids]

    @property
    def has_source(self) -> bool:
        """Whether the task has a source, be it known or not."""
        return self.source is None or self.source.shape[1] > 0

    @property
    def true(self) -> Floats:
        """True positions: east, north [m], [T + 1, N, 2]."""
        return self.position[..., :2]

    @property
    def n_steps(self) -> int:
        """Number of steps, T."""
        return len(self.time) - 1

    @property
    def perceived_return(self) -> float:
        """Sum of the rewards, as a mean over the UAVs."""
        return float(self.reward.mean(-1).sum())

    @property
    def lost(self) -> Flags:
        """Whether the UAV sent a message in the step that never arrives, [T + 1, N]."""
        return self.sent & (self.delay < 0)

    @property
    def late(self) -> Flags:
        """Whether the UAV sent a message in the step that arrives at a later one, [T + 1, N]."""
        return self.sent & (self.delay > 0)

    @cached_property
    def squares(self) -> NDArray[np.object_]:
        """What of each of the belief's square cells lies in the region, [C] polygons or several of
        them."""
        if self.cells is None:
            return np.zeros(0, object)
        gaps = np.diff(np.unique(self.cells[:, 0].round(3)))
        half = float(gaps.min()) / 2 if len(gaps) else 0.5
        boxes = shapely.box(*(self.cells - half).T, *(self.cells + half).T)
        return np.asarray(shapely.intersection(boxes, self.region))

    def entropy(self, step: int) -> float:
        """Entropy of the beliefs at an instant, summed over the sources [bit]."""
        return float(sum(-p * np.log2(p) for p in np.asarray(self.belief)[step].flat if p > 0))

    def save(self, path: Path) -> None:
        """Write the episode as JSON."""
        write_atomically(path, json.dumps(self.document(), separators=(",", ":")))

    def document(self) -> dict[str, Any]:
        """What a file holds of the episode, with numbers of ``DIGITS`` significant digits, times of
        more."""
        return {
            "schema": SCHEMA,
            "version": VERSION,
            "about": self.about,
            "meaning": COLUMNS,
            **{each.name: getattr(self, each.name) for each in fields(self)},
            "region": json.loads(shapely.to_geojson(self.region)),
            "landing_points": _listed(self.landing_points),
            **{name: _listed(getattr(self, name)) for name in COLUMNS},
            "time": _listed(self.time, TIME_DIGITS),
        }

    @classmethod
    def load(cls, path: Path) -> "Episode":
        """Read an episode from its file."""
        with named(path):
            text = read_text(path)
        try:
            found = json.loads(text)
            if (found.get("schema"), found.get("version")) != (SCHEMA, VERSION):
                raise ValueError(f"it is {found.get('schema')} of version {found.get('version')}")
            columns = {name: _column(name, found[name]) for name in COLUMNS}
            fixed = {f.name: found[f.name] for f in fields(cls) if f.name not in COLUMNS}
            fixed["region"] = shapely.from_geojson(json.dumps(found["region"]))
            fixed["origin"] = found["origin"] and tuple(found["origin"])
            fixed["landing_points"] = np.asarray(found["landing_points"], float)
            return cls(**fixed, **columns)
        except (
            AttributeError,
            LookupError,
            TypeError,
            ValueError,
            RecursionError,
            ShapelyError,
        ) as error:
            problem = f"no {error}" if isinstance(error, KeyError) else one_line(str(error))
            raise InputError(
                f"{path}: it is not an episode of version {VERSION}: {problem}"
            ) from error


COLUMNS: dict[str, str] = {
    each.name: cast(Any, each.type).__metadata__[0]
    for each in fields(Episode)
    if hasattr(each.type, "__metadata__")
}
"""What each column means, by its name."""

OUTPUTS = (
    keys.STATE,
    keys.MESSAGE,
    keys.MESSAGE_SENT,
    keys.RECEIVED,
    keys.DELAY,
    keys.BELIEF,
    keys.REWARD_TERMS,
    keys.SUCCESS,
)
"""Entries from which an episode is made, beside the reward; some settings lack some of them."""


def record(rollout: TensorDictBase, env: UavEnv, about: Mapping[str, Any]) -> list[Episode]:
    """The first episode of each world in a rollout [B, T] with the extras that ``OUTPUTS`` need."""
    episodes = []
    for world in range(len(rollout)):
        steps = cast(TensorDictBase, rollout[world].cpu())
        ended = cast(Tensor, steps["next", keys.DONE]).flatten()
        length = int(ended.int().argmax()) + 1 if ended.any() else len(ended)
        after = at_instant(cast(TensorDictBase, steps["next"])[:length])
        instants = cast(TensorDictBase, torch.cat([at_instant(steps[:1]), after]))  # type: ignore[arg-type]
        episodes.append(episode_of(instants, env, {**about, "world": world}))
    return episodes


def at_instant(outputs: TensorDictBase) -> TensorDictBase:
    """What an episode needs of an environment's outputs after a step, or at the reset, without a
    reward."""
    sent = outputs[keys.MESSAGE_SENT]
    reward = outputs.get(keys.REWARD, torch.zeros_like(sent, dtype=torch.float32)[..., None])
    return outputs.select(*OUTPUTS, strict=False).set(keys.REWARD, reward)


def episode_of(instants: TensorDictBase, env: UavEnv, about: Mapping[str, Any]) -> Episode:
    """The episode of one world from ``at_instant`` of the reset and of each step, stacked,
    [T + 1]."""
    message = cast(Tensor, instants[keys.MESSAGE])
    vehicles = env.simulation.vehicles
    state = cast(Tensor, instants[keys.STATE])
    n_drawn = len(vehicles.values.choices)
    truth = Truth.unpack(state, env.simulation.widths, n_drawn)
    sent = cast(Tensor, instants[keys.MESSAGE_SENT]).clone()
    sent[0] = False  # the server holds the first message from the reset on
    delay = instants.get(keys.DELAY, torch.zeros_like(sent[..., None], dtype=torch.long))
    own = env.server.messages(message)
    held = env.server.messages(instants.get(keys.RECEIVED, message))
    dt = env.scenario.clock.dt
    time = torch.arange(len(sent), dtype=torch.float64) * dt
    belief = instants.get(keys.BELIEF, None)
    grid = env.server.grid
    airspace = env.simulation.airspace
    region = int(env.server.region_of(own)[0])
    about = {**about, **_drawn(env, truth.drawn[:1])}
    over = airspace.regions[region]
    points = np.asarray(airspace.points[region, : airspace.n_points[region]].cpu())
    if env.scenario.battery.charging_points:  # else UAVs charge wherever they land
        charges = vehicles.chargers.view(airspace.points.shape[:2])[region].cpu()
        about["charging_points"] = _listed(points[charges[: len(points)].numpy()])
    level = about.get("drawn", {}).get("source.level_db")
    source = env.scenario.source
    n_sources = source.count if env.scenario.seeks_source else 0
    columns: dict[str, Any] = {
        "time": time,
        "position": truth.position,
        "target": own.target,
        "track": own.track,
        "battery": truth.battery,
        "spotted": own.spotted & (n_sources > 0),
        "source": truth.source[:, :n_sources],
        "emits": truth.emits[:, :n_sources],
        "sent": sent,
        "delay": delay[..., 0],
        "believed": held.position,
        "age": (held.age(time) / dt).round() * dt,  # times in messages are float32
        "reward": cast(Tensor, instants[keys.REWARD])[..., 0],
        "cells": None if belief is None or grid is None else grid.centres.cpu(),
        "belief": belief,
        "requests": truth.requests if env.simulation.widths.requests else None,
    }
    arrays: dict[str, Any] = {
        name: x if x is None else np.asarray(x) for name, x in columns.items()
    }
    return Episode(
        about={**about, "region": over.name, "damian": damian.__version__},
        region=over.polygon,
        origin=over.origin,
        landing_points=points,
        radius=footprint_radius(replace(source, level_db=level) if level else source),
        instant=vehicles.instant,
        success=bool(cast(Tensor, instants[keys.SUCCESS])[-1]),
        reward_terms={
            name: np.asarray(term) for name, term in instants.get(keys.REWARD_TERMS, {}).items()
        },
        **arrays,
    )


def _drawn(env: UavEnv, drawn: Tensor) -> dict[str, Any]:
    """What was drawn for the episode, [1, D], by key, and its wind: speed [m/s], direction
    [deg]."""
    values = env.simulation.vehicles.values
    about = {}
    if values.choices:
        about["drawn"] = dict(zip(values.choices, drawn[0].tolist(), strict=True))
    if env.simulation.vehicles.is_windy:
        about["wind"] = [
            float(values.get(f"wind.{name}", drawn)) for name in ("speed", "direction")
        ]
    return about


def _listed(values: Any, digits: int = DIGITS) -> Any:
    """Arrays as nested lists with so many significant digits, for JSON."""
    if isinstance(values, Mapping):
        return {name: _listed(each, digits) for name, each in values.items()}
    if values is None or not np.issubdtype(values.dtype, np.floating):
        return None if values is None else values.astype(int).tolist()
    size = np.abs(values, out=np.ones_like(values, float), where=values != 0)
    scale = 10.0 ** (digits - 1 - np.floor(np.log10(size)))
    return np.where(values == 0, 0.0, np.round(values * scale) / scale).tolist()


def _column(name: str, values: Any) -> Any:
    """An array from nested lists, or arrays by name."""
    if name == "reward_terms":
        return {term: np.asarray(each, float) for term, each in values.items()}
    kind = int if name == "delay" else bool if name in ("spotted", "sent", "emits") else float
    return None if values is None else np.asarray(values, kind)
