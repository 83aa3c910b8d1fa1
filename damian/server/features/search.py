"""Where a single source may be, by the latest detections of it: what the scripted policy weighs."""

from typing import NamedTuple

import torch
from torch import Tensor

from damian.common.tensors import distances
from damian.world.config import SourceConfig
from damian.world.messages import Messages

BLUR_M = 5.0
"""Standard deviation of a detection's place [m]: landing points stand for the ground around
them."""
TRUST = 0.9
"""Confidence, in [0, 1], that there is no source in a footprint in which a UAV hears nothing."""
RECENT = 3.0
"""A detection is recent until the source can have moved by this many footprint radii."""


class Seeking(NamedTuple):
    """What is known of a source before any message has come."""

    speed: float
    """Its largest speed [m/s]."""
    emits: float
    """Probability that it emits in a step."""
    dt: float
    """Length of a step [s]."""


def seeking_of(source: SourceConfig, dt: float) -> Seeking:
    """The properties of a source by its settings."""
    moves = source.motion == "dynamic"
    return Seeking(max(source.speed, source.local_speed) if moves else 0.0, source.emits, dt)


def search_weights(
    known: Messages,
    ground: Tensor,
    landed: Tensor,
    now: Tensor,
    radius: float | Tensor,
    seeking: Seeking,
) -> Tensor:
    """How much it is worth to each UAV to listen at landing points [*, L, 2], [*, N, L].

    How likely the source is there if a detection is recent at ``now`` [s], [*, 1]; else the same
    only at those nearest to the UAV, and outside its latest footprints about ``landed``
    [*, N, S, 2].
    """
    likely, recent = likely_places(known, ground, now, radius, seeking)
    distance = distances(known.target, ground)
    own = distance <= distance.amin(-2, keepdim=True)
    from_trail = distances(landed.flatten(-3, -2), ground).unflatten(-2, landed.shape[-3:-1])
    outside = (from_trail > radius_of(radius)).all(-2)
    fresh = (own & outside).to(likely.dtype)
    return torch.where(recent, likely, fresh * likely)


def radius_of(radius: float | Tensor) -> float | Tensor:
    """A radius, or drawn ones [*, 1, 1], for values with one more dimension."""
    return radius.unsqueeze(-1) if isinstance(radius, Tensor) else radius


def likely_places(
    known: Messages, ground: Tensor, now: Tensor, radius: float | Tensor, seeking: Seeking
) -> tuple[Tensor, Tensor]:
    """How likely the source is at each landing point, relative to the best one, [*, 1, L].

    The place of a detection grows uncertain with its age: the way of the source at full speed
    counts as two standard deviations. A footprint in which a UAV on the ground hears nothing now
    makes it less likely there. Also returns whether the latest detection is recent, [*, 1, 1].
    """
    detected = known.detected_time.squeeze(-1)
    has_detection = detected >= 0
    since = torch.where(has_detection, now - detected, torch.inf).unsqueeze(-1)
    from_detection = distances(known.detected_position.squeeze(-2), ground)
    outside = (from_detection - radius).clamp(min=0)
    deviation = BLUR_M + seeking.speed * since / 2
    log_detected = -(outside / deviation).square() / 2
    log_detected = torch.where(has_detection.unsqueeze(-1), log_detected, 0.0)
    half_step = seeking.dt / 2
    heard_now = known.time > now - half_step
    silent = ~known.spotted & ~known.in_flight & heard_now
    inside = distances(known.position, ground) <= radius
    covered = inside & silent.unsqueeze(-1)
    anyone_covers = covered.any(-2, keepdim=True)
    latest = since.amin(-2, keepdim=True)
    emits = torch.where(latest < half_step, 1.0, seeking.emits)
    log_silent = torch.log1p(-TRUST * emits * anyone_covers)
    log = log_detected.sum(-2, keepdim=True) + log_silent
    highest = log.amax(-1, keepdim=True)
    moved = torch.where(latest.isfinite(), latest * seeking.speed, torch.inf)
    return (log - highest).exp(), moved <= RECENT * radius
