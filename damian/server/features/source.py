"""Features of the paper's Table 2 about the source, as messages tell of it."""

import math

import torch
from torch import Tensor

from damian.server.config import ObservationConfig
from damian.server.features.base import FeatureCache, feature
from damian.world.simulation import Simulation

_FRESH = 10.0
"""After this number of steps a detection is no longer new."""


def columns_of_detections(simulation: Simulation, _: ObservationConfig) -> tuple[str, ...]:
    """What each value of ``detections`` is in a scenario."""
    n_sources = len(simulation.sources)
    which = [f"source {i + 1}" for i in range(n_sources)] if n_sources > 1 else []
    return ("east", "north", "newness", *which, "known")


def _any_has_detected(v: FeatureCache) -> Tensor:
    """Whether any UAV has ever detected a source, [*, 1]."""
    detected = v.messages.detected_time >= 0
    return detected.flatten(-2).any(-1, keepdim=True)


def known_sources(v: FeatureCache) -> tuple[Tensor, Tensor]:
    """Where each source was detected last, by any UAV [m], [*, K, 2], and whether it was, [*, K]."""
    times = v.messages.detected_time
    newest = times.argmax(-2, keepdim=True).unsqueeze(-1)
    places = v.messages.detected_position.take_along_dim(newest, -3).squeeze(-3)
    return places, times.amax(-2) >= 0


def _to_source(v: FeatureCache) -> Tensor:
    """Vector from each UAV to the estimated position of the nearest known source [m], [*, N, 2]."""
    messages = v.messages
    counts = messages.detected_time >= 0  # [*, N, K]
    weight = counts.to(messages.position.dtype).unsqueeze(-1)
    total = (messages.detected_position * weight).sum(-3, keepdim=True)
    n_counted = weight.sum(-3, keepdim=True).clamp(min=1)
    ways = total / n_counted - messages.position.unsqueeze(-2)  # [*, N, K, 2]
    return nearest_way(ways, counts.any(-2, keepdim=True))


def nearest_way(ways: Tensor, known: Tensor | None = None) -> Tensor:
    """The shortest of ways [*, K, 2], of those that are ``known`` [*, K] if there are any,
    [*, 2]."""
    if ways.shape[-2] == 1:
        return ways.squeeze(-2)
    length = ways.square().sum(-1)
    if known is not None:
        length = length.masked_fill(~known, torch.inf)
    best = length.argmin(-1)[..., None, None]
    return ways.take_along_dim(best, -2).squeeze(-2)


def _raw_source_distance(v: FeatureCache) -> Tensor:
    distance = torch.linalg.vector_norm(v(_to_source), dim=-1)
    return distance / v.scale


def _if_detected(v: FeatureCache, value: Tensor) -> Tensor:
    """The value if any UAV has ever detected a source, else 1."""
    return torch.where(v(_any_has_detected), value, 1.0)


def _bearing(v: FeatureCache) -> Tensor:
    """Bearing of the source, clockwise from north, [*, N] in (-pi, pi]."""
    east, north = v(_to_source).unbind(-1)
    # Within a millimetre of the source the bearing would be a rounding error: it is set to 0
    # (north).
    is_away = east.abs() + north.abs() > 1e-3
    return torch.atan2(east, north) * is_away


@feature("global", name="source_distance")
def _source_distance(v: FeatureCache) -> Tensor:
    """Distance to the estimated source, over the largest vertex distance; 1 if it is unknown,
    [*, N]."""
    return _if_detected(v, v(_raw_source_distance).clamp(max=1))


@feature("global", name="source_bearing")
def _source_bearing(v: FeatureCache) -> Tensor:
    """Bearing of the estimated source, clockwise from north, in turns; 1 if it is unknown,
    [*, N]."""
    turn = v(_bearing) / (2 * math.pi)
    return _if_detected(v, turn.remainder(1.0))


@feature("global", name="source_drift")
def _source_drift(v: FeatureCache) -> Tensor:
    """((bearing - track) wrapped to [-pi, pi) + pi) / 2 pi: 0.5 if the UAV flies straight at the
    source."""
    turn = (v(_bearing) - v.messages.track) / (2 * math.pi)
    return _if_detected(v, (turn + 0.5).remainder(1.0))


@feature("global", name="source_time")
def _source_time(v: FeatureCache) -> Tensor:
    """Time since any UAV detected the source, over ``observation.time_scale``; 1 if unknown,
    [*, N]."""
    latest = v.messages.detected_time.flatten(-2).amax(-1, keepdim=True)
    since = (v.context.now.unsqueeze(-1) - latest) / v.context.time_scale
    shared = _if_detected(v, since.clamp(max=1))
    return shared.expand_as(v.messages.time)


@feature("global", name="mean_distance_spotting")
def _mean_distance_spotting(v: FeatureCache) -> Tensor:
    """Mean distance of the spotting UAVs to the source; 0 if no UAV spots."""
    spotting = v.messages.spotted.to(v.scale.dtype)
    distance = v(_raw_source_distance) * spotting
    n_spotting = spotting.sum(-1, keepdim=True).clamp(min=1)
    mean = distance.sum(-1, keepdim=True) / n_spotting
    return mean.clamp(max=1).expand_as(spotting)


@feature("global", name="spotting_agents")
def _spotting_agents(v: FeatureCache) -> Tensor:
    """Share of the UAVs that spot the source, N_ss / N."""
    spotting = v.messages.spotted.to(v.scale.dtype)
    return spotting.mean(-1, keepdim=True).expand_as(spotting)


@feature("local", name="spotted")
def _spotted(v: FeatureCache) -> Tensor:
    """Whether the UAV detects the source, 0 or 1, [*, N]."""
    return v.messages.spotted.to(v.scale.dtype)


@feature(
    "global",
    [None, None],
    low=-1.0,
    name="detections",
    entries=columns_of_detections,
    rows="detections",
)
def _detections(v: FeatureCache) -> Tensor:
    """The newest detections of each source, at most one of each UAV, the newest first,
    [*, N, K D, C] for ``observation.detections`` D.

    Of each: the way to where the UAV heard it from where the observer is bound for, east and north,
    over half the largest vertex distance of the region; how new it is, from 1 down to 0 after ten
    steps; which source, 1 in one of K columns if there are several; and 1. Zeros stand for those
    that do not exist.
    """
    messages = v.messages
    times = messages.detected_time.transpose(-2, -1)  # [*, K, N]
    newest = times.argsort(dim=-1, descending=True, stable=True)
    newest = newest[..., : v.context.observation.detections]
    times = times.take_along_dim(newest, -1)  # [*, K, D]
    places = messages.detected_position.transpose(-3, -2)
    places = places.take_along_dim(newest.unsqueeze(-1), -2)
    own = v.wanted(messages.target)[..., None, None, :]
    ways = v.scaled(places.unsqueeze(-4) - own).clamp(-1, 1)  # [*, n, K, D, 2]
    age = (v.context.now[..., None, None] - times) / (_FRESH * v.context.dt)
    n_sources = times.shape[-2]
    told = [(1 - age).clamp(0, 1).unsqueeze(-1), torch.ones_like(age).unsqueeze(-1)]
    if n_sources > 1:
        which = torch.eye(n_sources, device=age.device).unsqueeze(-2)
        told.insert(1, which.expand(*age.shape, n_sources))
    shared = torch.cat(told, -1).unsqueeze(-4)
    rows = torch.cat([ways, shared.expand(*ways.shape[:-1], -1)], -1)
    exists = (times >= 0).unsqueeze(-1).unsqueeze(-4)
    return (rows * exists).flatten(-3, -2)
