"""The signal source (paper, section 3.2): the radius within which UAVs detect it, and its walk.

A dynamic source visits hotspots in a random order and, around each, a few inner points; it waits at
every stop. Walks are drawn once as padded tensors, from which positions follow in closed form. In a
concave polygon, the straight line between two stops may leave the polygon.
"""

import math
from typing import NamedTuple

import numpy as np
import shapely
import torch
from numpy.random import Generator
from torch import Tensor

from damian.world.config import SourceConfig
from damian.world.regions.polygon import Area, sample_interior

_TINY = 1e-9
_FULL_DISC_ROUNDS = 256
_ROUNDS = 320


class Walk(NamedTuple):
    """Walks of ``W`` sources over at most ``K`` stops; a static source has one stop and never
    leaves it.

    Padded stops lie at the first stop (walks that begin again have at least one), to which the walk
    then returns, or at the last one; they are left at the end of the walk and never reached.

    Attributes:
        stop: places, [W, K, 2] metres.
        arrive, depart: times, [W, K] seconds; the first arrival is 0, and a static source never
            departs.
        speed, acceleration: largest ones on the leg that leaves the stop, [W, K] m/s and m/s^2.
        emits: whether the source emits until it arrives at the next stop, [W, K] bool.
    """

    stop: Tensor
    arrive: Tensor
    depart: Tensor
    speed: Tensor
    acceleration: Tensor
    emits: Tensor


class Located(NamedTuple):
    """Where B sources are on their walks.

    Attributes:
        position: [B, 2] metres.
        stop, tour: index of the latest stop, and number of walks finished before this one, [B]
            int64.
        finished: whether the source has stopped for good, [B] bool.
    """

    position: Tensor
    stop: Tensor
    tour: Tensor
    finished: Tensor


def footprint_radius(config: SourceConfig) -> float:
    """Largest distance at which a UAV detects the source [m]: inverse-square law
    (paper, eq. 2 and 3)."""
    # R^2 = 4 pi I0 10^(level/10) / (4 pi I0 10^(microphone/10)), where all but the levels cancels.
    return 10 ** ((config.level_db - config.microphone_db) / 20)


def drawn_radius(level: Tensor, config: SourceConfig) -> Tensor:
    """As ``footprint_radius``, of drawn levels [dB], [*]."""
    return 10 ** ((level - config.microphone_db) / 20)


def draw_walks(
    polygon: Area,
    config: SourceConfig,
    n_walks: int,
    rng: Generator,
    start: np.ndarray | None = None,
) -> Walk:
    """Draw the walks of ``W = n_walks`` sources in a polygon of local metres, float32 on the CPU.

    They begin at ``start``, [2] metres, if it is given. Hotspots are uniform in the polygon, inner
    points uniform in the part of the disc around their hotspot that lies in it, or nearer where
    that part is very thin (under about 1 % of the disc).
    """
    shapely.prepare(polygon)
    n_hotspots = 1 if config.motion == "static" else config.n_hotspots
    places = sample_interior(polygon, n_walks * n_hotspots, rng)
    hotspots = places.reshape(n_walks, n_hotspots, 2)
    if start is not None:
        hotspots[:, 0] = start
    if config.motion == "dynamic":
        stops = _draw_stops(polygon, hotspots, config, rng)
        return _timed_walk(*stops, config, rng)
    zeros = torch.zeros(n_walks, 1)
    ones = torch.ones(n_walks, 1)
    stop = torch.as_tensor(hotspots, dtype=torch.float32)
    never = zeros + math.inf
    return Walk(stop, zeros, never, ones, ones, ones.bool())


def locate(walk: Walk, time: Tensor, loops: bool = False) -> Located:
    """Positions of sources ``time`` [B] seconds after their first walks began
    (in double precision).

    A source whose walk is over stays at its last stop, or ``loops``, if ``draw_walks`` has drawn it
    so.
    """
    last = walk.stop.shape[-2] - 1
    end = walk.depart[..., -1].to(time.dtype)
    finished = time >= end
    tour = torch.zeros_like(time)
    if loops:
        tour = (time / end).floor()
        finished = torch.zeros_like(finished)
        time = time - tour * end
    tour = tour.long()
    time = time.to(walk.depart.dtype)
    if last == 0:
        return Located(walk.stop[..., 0, :], tour, tour, finished)
    arrived = walk.arrive[..., 1:] <= time.unsqueeze(-1)
    stop = arrived.sum(-1)
    here = stop.unsqueeze(-1)
    following = (here + 1).clamp_max(last)
    ends = torch.cat([here, following], dim=-1)
    origin, target = walk.stop.take_along_dim(ends.unsqueeze(-1), -2).unbind(-2)
    depart, speed, acceleration = (
        x.gather(-1, here).squeeze(-1) for x in (walk.depart, walk.speed, walk.acceleration)
    )
    length = torch.linalg.vector_norm(target - origin, dim=-1)
    covered = _covered(length, speed, acceleration, time - depart)
    share = covered / length.clamp_min(_TINY)
    position = torch.lerp(origin, target, share.unsqueeze(-1))
    return Located(position, stop, tour, finished)


def leg_profile(length: Tensor, speed: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
    """Duration of the acceleration, and of a whole rest-to-rest leg, trapezoidal or triangular [s],
    [*]."""
    peak = torch.minimum(speed, (length * acceleration).sqrt())
    ramp = peak / acceleration
    return ramp, length / peak.clamp_min(torch.finfo(peak.dtype).tiny) + ramp


def _covered(length: Tensor, speed: Tensor, acceleration: Tensor, elapsed: Tensor) -> Tensor:
    """Distance covered on a leg, [*] metres; 0 before it begins, ``length`` once it is over."""
    ramp, duration = leg_profile(length, speed, acceleration)
    # The profile is symmetric: measured from the nearer end, speed has only risen or stayed the
    # same.
    from_end = torch.minimum(elapsed, duration - elapsed).clamp_min(0.0)
    rising = torch.minimum(from_end, ramp)
    near = acceleration * rising * (from_end - rising / 2)
    return torch.where(2 * elapsed > duration, length - near, near)


def _draw_stops(
    polygon: Area, hotspots: np.ndarray, config: SourceConfig, rng: Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Each hotspot [W, H, 2] m followed by its inner points, packed to the left and padded.

    Returns the places [W, K, 2] m, which stops are hotspots [W, K], and the number of real stops
    [W].
    """
    n_walks = len(hotspots)
    inner = _inner_points(polygon, hotspots, config, rng)
    grid = np.concatenate([hotspots[:, :, None], inner], axis=2)  # [W, H, 1 + max_stops, 2]
    n_inner = rng.integers(config.min_stops, config.max_stops, hotspots.shape[:2], endpoint=True)
    width = grid.shape[2]
    column = np.broadcast_to(np.arange(width), grid.shape[:3])
    column = column.reshape(n_walks, -1)
    real = column <= n_inner.repeat(width, axis=1)
    n = real.sum(1)
    real_first = np.argsort(~real, axis=1, kind="stable")
    order = real_first[:, : n.max()]
    places = grid.reshape(n_walks, -1, 2)
    place = np.take_along_axis(places, order[..., None], axis=1)
    hotspot = np.take_along_axis(column, order, axis=1) == 0
    return place, hotspot, n


def _inner_points(
    polygon: Area, hotspots: np.ndarray, config: SourceConfig, rng: Generator
) -> np.ndarray:
    """``max_stops`` points near each hotspot and inside the polygon, [W, H, max_stops, 2]
    metres."""
    # Points outside after the first rounds are drawn from ever smaller discs, so that this ends.
    halvings = np.maximum(np.arange(_ROUNDS) - _FULL_DISC_ROUNDS, 0)
    radii = config.local_distance / 2.0**halvings
    points = np.repeat(hotspots[:, :, None], config.max_stops, axis=2)
    flat = points.reshape(-1, 2)
    centre = flat.copy()
    missing = np.arange(len(flat))
    for radius in radii:
        distance = radius * np.sqrt(rng.random(len(missing)))
        angle = 2 * math.pi * rng.random(len(missing))
        direction = np.stack([np.sin(angle), np.cos(angle)], axis=1)
        offset = distance[:, None] * direction
        drawn = centre[missing] + offset
        accepted = shapely.contains_xy(polygon, drawn)
        flat[missing[accepted]] = drawn[accepted]
        missing = missing[~accepted]
        if not len(missing):
            break
    return flat.reshape(points.shape)


def _timed_walk(
    place: np.ndarray,
    hotspot: np.ndarray,
    n: np.ndarray,
    config: SourceConfig,
    rng: Generator,
) -> Walk:
    """Add waiting times, legs and emission to the stops."""
    shape = hotspot.shape
    loops = config.after_walk == "loop"
    wait = rng.uniform(config.min_wait, config.max_wait, shape)
    probability = config.emission_probability if config.emission == "per_stop" else 1.0
    emits = rng.random(shape) < probability
    if loops:  # room for the return to the first stop
        drawn = place, hotspot, wait, emits
        place, hotspot, wait, emits = (
            np.concatenate([each, each[:, -1:]], axis=1) for each in drawn
        )
    last = (n - 1)[:, None]
    column = np.arange(hotspot.shape[1])
    padded = column > last
    after = np.zeros_like(last) if loops else last
    rest = np.take_along_axis(place, after[..., None], axis=1)
    place = np.where(padded[..., None], rest, place)
    returns = loops & (column == last)
    to_hotspot = np.roll(hotspot, -1, axis=1) | returns
    speed = np.where(to_hotspot, config.speed, config.local_speed)
    acceleration = np.where(to_hotspot, config.acceleration, config.local_acceleration)
    way = np.diff(place, axis=1)
    length = np.linalg.norm(way, axis=2)
    legs = length, speed[:, :-1], acceleration[:, :-1]
    _, leg = leg_profile(*map(torch.as_tensor, legs))
    arrive = np.zeros(hotspot.shape)
    between = wait[:, :-1] + leg.numpy()
    arrive[:, 1:] = np.cumsum(between, axis=1)
    depart = arrive + wait
    end = (
        np.take_along_axis(arrive, last + 1, axis=1)
        if loops
        else np.take_along_axis(depart, last, axis=1)
    )
    depart = np.where(padded, np.maximum(end, _TINY), depart)
    arrive = np.where(padded, math.inf, arrive)
    columns = place, arrive, depart, speed, acceleration
    numbers = (torch.as_tensor(each).float() for each in columns)
    return Walk(*numbers, emits=torch.as_tensor(emits))
