"""Messages turned into the named features of the paper's Table 2.

``observe`` is pure and batched, and reads nothing but the messages that it is given: the caller decides
whether these are all messages or those that have arrived.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from damian.common import checks
from damian.common.tensors import gather_rows
from damian.world.battery import BatteryConfig, observed
from damian.world.coverage import FootprintTables, covered_share
from damian.world.messages import Messages

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
    """Show each UAV the age of the message that the server holds of it (age of information). The critic does
    not see it: after back-updating, it would tell how far from the end of its batch a step was."""
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


class ServerContext(NamedTuple):
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


def observe(messages: Messages, context: ServerContext, names: list[str]) -> dict[str, Tensor]:
    """Features by name (Table 2), each scaled to [0, 1].

    Args:
        messages: of N UAVs, [*, N].
        context: with leading dimensions [*].
        names: wanted features; others are not computed.

    Returns:
        Each feature [*, N]; ``agent_distances`` [*, N, N-1], the others in index order.
    """
    view = FeatureCache(messages, context)
    return {name: _FEATURES[name](view) for name in names}


def stack(features: dict[str, Tensor], names: list[str]) -> Tensor:
    """Observation vector in the order of ``names``, [*, N, F]."""
    columns = [features[n] if n == "agent_distances" else features[n].unsqueeze(-1) for n in names]
    return torch.cat(columns, -1)


class FeatureCache:
    """Messages, and the quantities that several features share, each computed once and only on demand."""

    def __init__(self, messages: Messages, context: ServerContext) -> None:
        self.messages, self.context = messages, context
        self._shared: dict[Callable, Tensor] = {}

    def __call__(self, compute: Callable[["FeatureCache"], Tensor]) -> Tensor:
        if compute not in self._shared:
            self._shared[compute] = compute(self)
        return self._shared[compute]

    @property
    def scale(self) -> Tensor:
        return self.context.scale.unsqueeze(-1)


def _known(v: FeatureCache) -> Tensor:
    """Has the UAV ever heard the source, [*, N]."""
    return v.messages.detected_time >= 0


def _ever(v: FeatureCache) -> Tensor:
    """Has anybody, [*, 1]."""
    return v(_known).any(-1, keepdim=True)


def _to_source(v: FeatureCache) -> Tensor:
    """From each UAV to where the source is believed, [*, N, 2] metres."""
    told, when = v(_known), v.messages.detected_time
    if v.context.newest:
        told = told & (when == when.amax(-1, keepdim=True))
    known = told.to(v.messages.position.dtype)
    places = (v.messages.detected_position * known.unsqueeze(-1)).sum(-2, keepdim=True)
    estimate = places / known.sum(-1).clamp(min=1)[..., None, None]
    return estimate - v.messages.position


def _raw_source_distance(v: FeatureCache) -> Tensor:
    return torch.linalg.vector_norm(v(_to_source), dim=-1) / v.scale


def _bearing(v: FeatureCache) -> Tensor:
    """Bearing of the source, clockwise from north, [*, N] in (-pi, pi]."""
    east, north = v(_to_source).unbind(-1)
    # Within a millimetre of the source there is no bearing, only rounding errors: north it is.
    away = east.abs() + north.abs() > 1e-3
    return torch.atan2(east, north) * away


def _pairwise(v: FeatureCache) -> Tensor:
    """Distances between UAVs over the scale, [*, N, N]."""
    place = v.messages.position
    offset = place.unsqueeze(-2) - place.unsqueeze(-3)
    return torch.linalg.vector_norm(offset, dim=-1) / v.scale.unsqueeze(-1)


def _source_distance(v: FeatureCache) -> Tensor:
    return torch.where(v(_ever), v(_raw_source_distance).clamp(max=1), 1.0)


def _source_bearing(v: FeatureCache) -> Tensor:
    return torch.where(v(_ever), torch.remainder(v(_bearing) / (2 * math.pi), 1.0), 1.0)


def _source_drift(v: FeatureCache) -> Tensor:
    """(wrapped (bearing - track) + pi) / 2 pi: aligned is 0.5."""
    turn = (v(_bearing) - v.messages.track) / (2 * math.pi)
    return torch.where(v(_ever), torch.remainder(turn + 0.5, 1.0), 1.0)


def _source_time(v: FeatureCache) -> Tensor:
    latest = v.messages.detected_time.amax(-1, keepdim=True)
    since = (v.context.now.unsqueeze(-1) - latest) / v.context.time_scale
    return torch.where(v(_ever), since.clamp(max=1), 1.0).expand_as(v.messages.time)


def _agent_distances(v: FeatureCache) -> Tensor:
    n = v.messages.time.shape[-1]
    others = [[j for j in range(n) if j != i] for i in range(n)]
    index = torch.tensor(others, dtype=torch.long, device=v.scale.device).view(n, n - 1)
    pairwise = v(_pairwise)
    return pairwise.gather(-1, index.expand(*pairwise.shape[:-1], n - 1)).clamp(max=1)


def _coverage(v: FeatureCache) -> Tensor:
    if v.context.footprints is None:
        raise ValueError("coverage needs the footprint tables")
    trail = v.messages.trail
    return covered_share(v.context.footprints, trail, gather_rows(v.context.points, trail))


def _mean_distance(v: FeatureCache) -> Tensor:
    n = v.messages.time.shape[-1]
    return (v(_pairwise).sum(-1) / max(n - 1, 1)).clamp(max=1)


def _mean_distance_not_spotting(v: FeatureCache) -> Tensor:
    """Mean distance to the other UAVs that do not spot; 0 for a spotting UAV or without such others."""
    silent = (~v.messages.spotted).to(v.scale.dtype)
    others = silent.sum(-1, keepdim=True) - 1
    total = (v(_pairwise) * silent.unsqueeze(-2)).sum(-1) * silent
    return (total / others.clamp(min=1)).clamp(max=1)


def _mean_distance_spotting(v: FeatureCache) -> Tensor:
    """Mean distance of the spotting UAVs to the source; 0 if there is none."""
    spotting = v.messages.spotted.to(v.scale.dtype)
    total = (v(_raw_source_distance) * spotting).sum(-1, keepdim=True)
    mean = total / spotting.sum(-1, keepdim=True).clamp(min=1)
    return mean.clamp(max=1).expand_as(spotting)


def _spotting_agents(v: FeatureCache) -> Tensor:
    """N_ss / N."""
    spotting = v.messages.spotted.to(v.scale.dtype)
    return spotting.mean(-1, keepdim=True).expand_as(spotting)


def _battery(v: FeatureCache) -> Tensor:
    return observed(v.messages.battery, v.context.battery) / 100


def _spotted(v: FeatureCache) -> Tensor:
    return v.messages.spotted.to(v.scale.dtype)


def _age(v: FeatureCache) -> Tensor:
    return (v.messages.age(v.context.now) / v.context.age_scale).clamp(max=1)


_FEATURES: dict[str, Callable[[FeatureCache], Tensor]] = {
    name: globals()[f"_{name}"] for name in (*GLOBAL, *LOCAL, "age")
}
