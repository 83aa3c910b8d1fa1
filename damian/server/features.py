"""The server node's view: a snapshot of messages turned into the named features of Table 2.

``observe`` is pure and batched. It knows nothing but the snapshot that it is given: whether that is
everything (nothing delayed) or what has arrived so far is its caller's business.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from damian.common import checks
from damian.world.airspace import rows
from damian.world.battery import BatteryConfig, observed
from damian.world.coverage import FootprintTables, covered_share

LOCAL = ("battery", "spotted")
GLOBAL = (
    "source_distance",
    "source_bearing",
    "source_drift",
    "source_time",
    "agent_distances",
    "coverage",
    "mean_distance",
    "mean_distance_not_spotting",
    "mean_distance_spotting",
    "spotting_agents",
)


@dataclass
class ObservationConfig:
    """Which features actor and critic see."""

    local_features: list[str] = field(default_factory=lambda: ["spotted"])
    """Features of the UAV itself: battery, spotted."""
    global_features: list[str] = field(
        default_factory=lambda: ["source_distance", "source_bearing", "source_time"]
    )
    """Features that the server computes from everybody's messages."""
    ctde: bool = False
    """Centralised training, decentralised execution: the actor sees the local features only."""
    time_scale: float | None = None
    """Times are divided by this [s]; by the episode's time limit, or an hour, if not given."""
    age: bool = False
    """Show each UAV how old what the server holds of it is (age of information, SPEC 4). Not the critic: to
    the one that learns in hindsight it would say how far from its last batch's end a step was."""
    age_scale: float = 10.0
    """Ages are divided by this [s]."""
    own: bool = False
    """A UAV knows its own latest message at once, with no need to hear of it from the server; else, as in the
    paper, all that it sees comes from there."""
    estimate: str = "mean"
    """Where the server believes the source: at the ``mean`` of the places of all UAVs' latest detections, or
    only of the ``newest`` of these: a source that moves has left the older ones."""
    window: int = 2
    """Positions over which the coverage area is counted."""

    def __post_init__(self) -> None:
        for name in self.local_features:
            checks.one_of("observation.local_features", name, LOCAL)
        for name in self.global_features:
            checks.one_of("observation.global_features", name, GLOBAL)
        if self.time_scale is not None:
            checks.above("observation.time_scale", self.time_scale, 0.0, "s")
        checks.above("observation.age_scale", self.age_scale, 0.0, "s")
        checks.one_of("observation.estimate", self.estimate, ("mean", "newest"))
        checks.in_range("observation.window", self.window, 1, 16)
        checks.require(
            bool(self.actor),
            "observation.local_features",
            self.local_features,
            "leaves the actor blind",
        )

    @property
    def actor(self) -> list[str]:
        """Features of the actor's observation, in order."""
        seen = self.local_features if self.ctde else self.critic
        return [*seen, "age"] if self.age else list(seen)

    @property
    def critic(self) -> list[str]:
        """Features of the critic's observation, in order."""
        return [*self.global_features, *self.local_features]


class Snapshot(NamedTuple):
    """The messages that the server holds, one per UAV; each field [*, N] or [*, N, 2].

    A message carries SPEC 3's content and, so that everything can be computed from it alone, the UAV's
    count of motions and its latest landing points.
    """

    time: Tensor
    """Generation time [s]."""
    position: Tensor
    """East, north [m]."""
    target: Tensor
    """Landing point that the UAV is bound for, east, north [m]."""
    track: Tensor
    """Heading of the latest flight, clockwise from north [rad]."""
    battery: Tensor
    """[%], exact; what is observed is rounded."""
    spotted: Tensor
    """Does the UAV spot the source, bool."""
    motions: Tensor
    """Motions since the UAV spotted the source before this message, holding included."""
    detected_time: Tensor
    """Time of the latest detection [s]; -1 if there was none."""
    detected_position: Tensor
    """Where the UAV was then, east, north [m]."""
    trail: Tensor
    """Flat ids of its last landing points, newest first, [*, N, window]."""

    def pack(self) -> Tensor:
        """Messages as they are sent: a row of numbers each, fields in order, [*, N, F] float32."""
        fields = zip(self, _WIDTHS, strict=True)
        columns = [(field.unsqueeze(-1) if width == 1 else field).float() for field, width in fields]
        return torch.cat(columns, -1)

    @classmethod
    def unpack(cls, messages: Tensor) -> "Snapshot":
        """The fields of messages [*, N, F]; floats are views of them."""
        window = messages.shape[-1] - sum(width or 0 for width in _WIDTHS)
        columns = messages.split([width or window for width in _WIDTHS], -1)
        fields = [c.squeeze(-1) if width == 1 else c for c, width in zip(columns, _WIDTHS, strict=True)]
        snapshot = cls._make(fields)
        return snapshot._replace(
            spotted=snapshot.spotted > 0.5, motions=snapshot.motions.long(), trail=snapshot.trail.long()
        )


_WIDTHS = (1, 2, 2, 1, 1, 1, 1, 1, 2, None)
"""Numbers that each field of a snapshot takes in a message; the trail, the rest."""

EXACT = 2**24
"""Whole numbers in a message are exact below this."""


class Knowledge(NamedTuple):
    """What the server knows besides the messages."""

    now: Tensor
    """[s], [*]."""
    scale: Tensor
    """Largest vertex distance of the region [m], [*]."""
    time_scale: float
    """[s]."""
    battery: BatteryConfig
    """For the resolution of what is observed."""
    footprints: FootprintTables | None
    """For the coverage; None if nobody asks for it."""
    points: Tensor
    """Landing points by flat id, [R*L, 2] metres."""
    age_scale: float
    """[s]."""
    newest: bool = False
    """Do only the newest detections tell where the source is?"""


def observe(snapshot: Snapshot, server: Knowledge, names: list[str]) -> dict[str, Tensor]:
    """Features by name (Table 2), each scaled to [0, 1].

    Args:
        snapshot: messages, [*, N].
        server: with leading dimensions [*].
        names: wanted features; others are not computed.

    Returns:
        Each feature [*, N]; ``agent_distances`` [*, N, N-1], the others in index order.
    """
    view = _View(snapshot, server)
    return {name: _FEATURES[name](view) for name in names}


def stack(features: dict[str, Tensor], names: list[str]) -> Tensor:
    """Observation vector in the order of ``names``, [*, N, F]."""
    columns = [features[n] if n == "agent_distances" else features[n].unsqueeze(-1) for n in names]
    return torch.cat(columns, -1)


class _View:
    """A snapshot with what several features share, each computed once and only on demand."""

    def __init__(self, snapshot: Snapshot, server: Knowledge) -> None:
        self.snapshot, self.server = snapshot, server
        self._shared: dict[Callable, Tensor] = {}

    def __call__(self, compute: Callable[["_View"], Tensor]) -> Tensor:
        if compute not in self._shared:
            self._shared[compute] = compute(self)
        return self._shared[compute]

    @property
    def scale(self) -> Tensor:
        return self.server.scale.unsqueeze(-1)


def _known(v: _View) -> Tensor:
    """Has the UAV ever heard the source, [*, N]."""
    return v.snapshot.detected_time >= 0


def _ever(v: _View) -> Tensor:
    """Has anybody, [*, 1]."""
    return v(_known).any(-1, keepdim=True)


def _to_source(v: _View) -> Tensor:
    """From each UAV to where the source is believed, [*, N, 2] metres."""
    told, when = v(_known), v.snapshot.detected_time
    if v.server.newest:
        told = told & (when == when.amax(-1, keepdim=True))
    known = told.to(v.snapshot.position.dtype)
    places = (v.snapshot.detected_position * known.unsqueeze(-1)).sum(-2, keepdim=True)
    estimate = places / known.sum(-1).clamp(min=1)[..., None, None]
    return estimate - v.snapshot.position


def _raw_source_distance(v: _View) -> Tensor:
    return torch.linalg.vector_norm(v(_to_source), dim=-1) / v.scale


def _bearing(v: _View) -> Tensor:
    """Bearing of the source, clockwise from north, [*, N] in (-pi, pi]."""
    east, north = v(_to_source).unbind(-1)
    # Within a millimetre of the source there is no bearing, only rounding errors: north it is.
    away = east.abs() + north.abs() > 1e-3
    return torch.atan2(east, north) * away


def _pairwise(v: _View) -> Tensor:
    """Distances between UAVs over the scale, [*, N, N]."""
    place = v.snapshot.position
    offset = place.unsqueeze(-2) - place.unsqueeze(-3)
    return torch.linalg.vector_norm(offset, dim=-1) / v.scale.unsqueeze(-1)


def _source_distance(v: _View) -> Tensor:
    return torch.where(v(_ever), v(_raw_source_distance).clamp(max=1), 1.0)


def _source_bearing(v: _View) -> Tensor:
    return torch.where(v(_ever), torch.remainder(v(_bearing) / (2 * math.pi), 1.0), 1.0)


def _source_drift(v: _View) -> Tensor:
    """(wrapped (bearing - track) + pi) / 2 pi: aligned is 0.5."""
    turn = (v(_bearing) - v.snapshot.track) / (2 * math.pi)
    return torch.where(v(_ever), torch.remainder(turn + 0.5, 1.0), 1.0)


def _source_time(v: _View) -> Tensor:
    latest = v.snapshot.detected_time.amax(-1, keepdim=True)
    since = (v.server.now.unsqueeze(-1) - latest) / v.server.time_scale
    return torch.where(v(_ever), since.clamp(max=1), 1.0).expand_as(v.snapshot.time)


def _agent_distances(v: _View) -> Tensor:
    n = v.snapshot.time.shape[-1]
    others = [[j for j in range(n) if j != i] for i in range(n)]
    index = torch.tensor(others, dtype=torch.long, device=v.scale.device).view(n, n - 1)
    pairwise = v(_pairwise)
    return pairwise.gather(-1, index.expand(*pairwise.shape[:-1], n - 1)).clamp(max=1)


def _coverage(v: _View) -> Tensor:
    if v.server.footprints is None:
        raise ValueError("coverage needs the footprint tables")
    trail = v.snapshot.trail
    return covered_share(v.server.footprints, trail, rows(v.server.points, trail))


def _mean_distance(v: _View) -> Tensor:
    n = v.snapshot.time.shape[-1]
    return (v(_pairwise).sum(-1) / max(n - 1, 1)).clamp(max=1)


def _mean_distance_not_spotting(v: _View) -> Tensor:
    """Mean distance to the other UAVs that do not spot; 0 for a spotting UAV or without such others."""
    silent = (~v.snapshot.spotted).to(v.scale.dtype)
    others = silent.sum(-1, keepdim=True) - 1
    total = (v(_pairwise) * silent.unsqueeze(-2)).sum(-1) * silent
    return (total / others.clamp(min=1)).clamp(max=1)


def _mean_distance_spotting(v: _View) -> Tensor:
    """Mean distance of the spotting UAVs to the source; 0 if there is none."""
    spotting = v.snapshot.spotted.to(v.scale.dtype)
    total = (v(_raw_source_distance) * spotting).sum(-1, keepdim=True)
    mean = total / spotting.sum(-1, keepdim=True).clamp(min=1)
    return mean.clamp(max=1).expand_as(spotting)


def _spotting_agents(v: _View) -> Tensor:
    """N_ss / N."""
    spotting = v.snapshot.spotted.to(v.scale.dtype)
    return spotting.mean(-1, keepdim=True).expand_as(spotting)


def _battery(v: _View) -> Tensor:
    return observed(v.snapshot.battery, v.server.battery) / 100


def _spotted(v: _View) -> Tensor:
    return v.snapshot.spotted.to(v.scale.dtype)


def _age(v: _View) -> Tensor:
    return ((v.server.now.unsqueeze(-1) - v.snapshot.time) / v.server.age_scale).clamp(max=1)


_FEATURES: dict[str, Callable[[_View], Tensor]] = {
    name: globals()[f"_{name}"] for name in (*GLOBAL, *LOCAL, "age")
}
