"""The features of the paper's Table 2, computed from messages.

``observe`` is pure and batched, and reads nothing but the messages it is given: the caller decides whether
these are the latest messages sent or the latest received.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from damian.common import checks, devices
from damian.common.registry import Registry, require_parentheses
from damian.common.tensors import gather_rows
from damian.server.feature_cache import FeatureCache, ServerContext
from damian.world.battery import observed
from damian.world.coverage import covered_share, own_covered_share, updated_share
from damian.world.messages import Messages


@dataclass
class ObservationConfig:
    """Which features the actor and the critic observe."""

    local_features: list[str] = field(default_factory=lambda: ["spotted"])
    """Features of the UAV itself: battery, spotted, or ``package.module:feature`` of one's own."""
    global_features: list[str] = field(
        default_factory=lambda: ["source_distance", "source_bearing", "source_time"]
    )
    """Features that the server computes from the messages of all UAVs (Table 2): source_distance,
    source_bearing, source_drift, source_time, agent_distances, coverage, mean_distance,
    mean_distance_not_spotting, mean_distance_spotting, spotting_agents, or one's own."""
    ctde: bool = False
    """Centralised training, decentralised execution: the actor observes only the local features."""
    time_scale: float | None = None
    """Times are divided by this [s]; if not given, by the episode's time limit, or else by an hour."""
    age: bool = False
    """Append to each actor's observation the age of the message that the server holds of its UAV (age of
    information). The critic does not observe it: after back-updating, the age would tell the critic how far a
    step is from the end of its batch."""
    age_scale: float = 10.0
    """Ages are divided by this [s]."""
    own: bool = False
    """Each UAV observes its own latest message without delay. If false, as in the paper, its whole
    observation follows from the messages that the server holds, its own included."""
    estimate: str = "mean"
    """How the server estimates the source's position. ``mean``: the mean position of all UAVs' latest
    detections. ``newest``: the mean of only the newest of these, as a moving source has left the older
    ones."""
    belief: list[str] = field(default_factory=list)
    """Features of where the source is, by Bayes' rule from all messages that have arrived, appended to what
    actor and critic observe: belief_gain (for each discrete action, the probability that it leads to where
    the source is detected), belief_moments, belief_map, or ``package.module:feature`` of one's own."""
    belief_cell: float | None = None
    """Edge of a cell of the belief [m]; if not given, 0.8 footprint radii, or more in large regions."""
    window: int = 2
    """Number of each UAV's latest landing points whose footprints the coverage counts."""

    def __post_init__(self) -> None:
        checks.types("observation", self)
        for scope in ("local", "global"):
            for name in getattr(self, f"{scope}_features"):
                check_feature(f"observation.{scope}_features", name, scope)
            checks.distinct(f"observation.{scope}_features", getattr(self, f"{scope}_features"))
        for name in self.belief:
            check_feature("observation.belief", name, "belief")
        checks.distinct("observation.belief", self.belief)
        if self.belief_cell is not None:
            checks.above("observation.belief_cell", self.belief_cell, 0.0, "m")
        if self.time_scale is not None:
            checks.above("observation.time_scale", self.time_scale, 0.0, "s")
        checks.above("observation.age_scale", self.age_scale, 0.0, "s")
        checks.one_of("observation.estimate", self.estimate, ("mean", "newest"))
        checks.whole("observation.window", self.window, 1, 16)
        blind = "actor" if not self.actor else "critic"  # which does not observe ages
        problem = f"leaves the {blind} blind"
        checks.require(
            bool(self.critic and self.actor), "observation.local_features", self.local_features, problem
        )

    @property
    def actor(self) -> list[str]:
        """Features of the actor's observation, in order."""
        features = [*self.local_features, *self.belief] if self.ctde else self.critic
        return [*features, "age"] if self.age else features

    @property
    def critic(self) -> list[str]:
        """Features of the critic's observation, in order."""
        return [*self.global_features, *self.local_features, *self.belief]


def observe(messages: Messages, context: ServerContext, names: list[str]) -> dict[str, Tensor]:
    """Features by name (Table 2, and of one's own).

    Args:
        messages: one message of each of N UAVs, [*, N].
        context: with the leading dimensions [*] of the messages.
        names: features to compute.

    Returns:
        Each feature [*, N], in [0, 1] if it is one of Table 2; but ``agent_distances`` [*, N, N-1], to the
        other UAVs in index order, and features of one's own in the shape and range that they declare.

    Raises:
        ValueError: ``coverage`` is among the names, but the context has no footprint tables.
        InputError: a feature reads a sensor that does not exist.
    """
    cache = FeatureCache(messages, context)
    return {name: FEATURES.get(name, "feature").compute(cache) for name in names}


def observe_own(known: Messages, context: ServerContext, names: list[str]) -> dict[str, Tensor]:
    """Features by name, as each UAV computes its own from the messages that it knows.

    Args:
        known: messages [*, N, N] (receiver, sender).
        context: with the leading dimensions [*, N] of the messages.
        names: features to compute.

    Returns:
        As ``observe``, each feature [*, N] or [*, N, width].
    """
    cache, sender = FeatureCache(known, context, own_only=True), known.time.dim() - 1
    values = {name: FEATURES.get(name, "feature").compute(cache) for name in names}
    return {
        name: (each if each.shape[sender] == 1 else cache.wanted(each)).squeeze(sender)
        for name, each in values.items()
    }


def stack(features: dict[str, Tensor], names: list[str]) -> Tensor:
    """Observation vector in the order of ``names``, [*, N, F] float32, whatever the features' types are."""
    single = {name for name in names if FEATURES.get(name, "feature").width == 1}
    columns = [features[name].unsqueeze(-1) if name in single else features[name] for name in names]
    return torch.cat(columns, -1).float()


def feature_bounds(features: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Lowest and highest possible values of features, each in the shape of the feature."""
    found = {name: FEATURES.get(name, "feature") for name in features}
    low = {name: torch.full(values.shape, found[name].low) for name, values in features.items()}
    high = {name: torch.full(values.shape, found[name].high) for name, values in features.items()}
    return low, high


class Feature(NamedTuple):
    """How a feature is computed, its shape and range, and who may observe it."""

    compute: Callable[[FeatureCache], Tensor]
    """From messages [*, N] to values [*, N] or, if it has several for each UAV, [*, N, width]."""
    scope: str
    """``local`` (of the UAV itself), ``global`` (of all UAVs), ``belief`` (of all UAVs' messages so far) or
    ``actor`` (never for the critic)."""
    width: int | None = 1
    """Number of values for each UAV; None if it depends on the settings."""
    low: float = 0.0
    """Lowest possible value."""
    high: float = 1.0
    """Highest possible value."""


def feature(
    scope: str, width: int | None = 1, low: float = 0.0, high: float = 1.0
) -> Callable[[Callable[[FeatureCache], Tensor]], Feature]:
    """Decorator that makes a feature of a function.

    The function reads ``cache.messages`` (fields [*, N]), ``cache.reading`` (the sensors of one's own) and
    ``cache.context`` (time, scales, landing points), and must be pure, batched over * and, for
    ``env.compile()``, free of branches on data. ``cache(other)`` shares an intermediate result between
    features.

    Args:
        scope: ``local`` (follows from the UAV's own message), ``global`` (from the messages of all UAVs) or
            ``belief`` (from all messages so far, by ``cache.belief`` and ``cache.grid``).
        width: number of values for each UAV. With 1 the function returns [*, N], with more [*, N, width];
            None if the number depends on the number of UAVs, as with the distances to the other UAVs.
        low: lowest possible value.
        high: highest possible value. Networks learn best from values about 1 in size.

    Raises:
        InputError: there is no such scope, the width is not positive, the range is empty or not finite, or
            the decorator has no parentheses.

    Examples:
        >>> @feature("local")
        ... def track(cache):  # in lab.py, used as observation.local_features=[spotted,lab:track]
        ...     return cache.messages.track / (2 * math.pi)
    """
    require_parentheses(scope, '@damian.feature("local")')
    checks.one_of("scope of a feature", scope, ("local", "global", "belief", "actor"))
    if width is not None:
        checks.whole("width of a feature", width, 1)
    good = math.isfinite(low) and math.isfinite(high) and low < high
    checks.require(good, "range of a feature", f"low={low}, high={high}", "are not finite with low < high")
    return lambda compute: Feature(compute, scope, width, low, high)


def _not_a_feature(found: Any) -> str | None:
    return None if isinstance(found, Feature) else "is no feature: decorate the function with damian.feature"


FEATURES = Registry[Feature]("feature", _not_a_feature)
"""Features by name (Table 2); one's own as ``package.module:name``."""


def check_feature(key: str, name: str, scope: str) -> None:
    """Require a feature of a scope.

    Raises:
        InputError: there is no such feature, or it has another scope.
    """
    if name in FEATURES or ":" not in str(name):
        checks.one_of(key, name, feature_names(scope))
    found = FEATURES.get(name, key)
    checks.require(found.scope == scope, key, name, f"is a {found.scope} feature, not a {scope} one")


def feature_names(scope: str) -> list[str]:
    """Names of the registered features of a scope, in the order of Table 2."""
    return [name for name, found in FEATURES.items() if found.scope == scope]


def _has_detected(v: FeatureCache) -> Tensor:
    """Has this UAV ever detected the source, [*, N]."""
    return v.messages.detected_time >= 0


def _any_has_detected(v: FeatureCache) -> Tensor:
    """Has any UAV ever detected the source, [*, 1]."""
    return v(_has_detected).any(-1, keepdim=True)


def _to_source(v: FeatureCache) -> Tensor:
    """Vector from each UAV to the estimated position of the source [m], [*, N, 2]."""
    counts, detected_time = v(_has_detected), v.messages.detected_time
    if v.context.newest:
        counts = counts & (detected_time == detected_time.amax(-1, keepdim=True))
    weight = counts.to(v.messages.position.dtype)
    total = (v.messages.detected_position * weight.unsqueeze(-1)).sum(-2, keepdim=True)
    estimate = total / weight.sum(-1).clamp(min=1)[..., None, None]
    return estimate - v.messages.position


def _raw_source_distance(v: FeatureCache) -> Tensor:
    return torch.linalg.vector_norm(v(_to_source), dim=-1) / v.scale


def _bearing(v: FeatureCache) -> Tensor:
    """Bearing of the source, clockwise from north, [*, N] in (-pi, pi]."""
    east, north = v(_to_source).unbind(-1)
    # Within a millimetre of the source the bearing would be a rounding error: it is set to 0 (north).
    away = east.abs() + north.abs() > 1e-3
    return torch.atan2(east, north) * away


def _pairwise(v: FeatureCache) -> Tensor:
    """Distances from the wanted UAVs to all, over the largest vertex distance of the region, [*, N, N]."""
    position = v.messages.position
    # Not by a matrix product, which loses digits where UAVs are close to each other.
    distance = torch.cdist(v.wanted(position), position, compute_mode="donot_use_mm_for_euclid_dist")
    return distance / v.scale.unsqueeze(-1)


@FEATURES.register("source_distance")
@feature("global")
def _source_distance(v: FeatureCache) -> Tensor:
    return torch.where(v(_any_has_detected), v(_raw_source_distance).clamp(max=1), 1.0)


@FEATURES.register("source_bearing")
@feature("global")
def _source_bearing(v: FeatureCache) -> Tensor:
    return torch.where(v(_any_has_detected), torch.remainder(v(_bearing) / (2 * math.pi), 1.0), 1.0)


@FEATURES.register("source_drift")
@feature("global")
def _source_drift(v: FeatureCache) -> Tensor:
    """((bearing - track) wrapped to [-pi, pi) + pi) / 2 pi: 0.5 if the UAV flies straight at the source."""
    turn = (v(_bearing) - v.messages.track) / (2 * math.pi)
    return torch.where(v(_any_has_detected), torch.remainder(turn + 0.5, 1.0), 1.0)


@FEATURES.register("source_time")
@feature("global")
def _source_time(v: FeatureCache) -> Tensor:
    latest = v.messages.detected_time.amax(-1, keepdim=True)
    since = (v.context.now.unsqueeze(-1) - latest) / v.context.time_scale
    return torch.where(v(_any_has_detected), since.clamp(max=1), 1.0).expand_as(v.messages.time)


@FEATURES.register("agent_distances")
@feature("global", width=None)
def _agent_distances(v: FeatureCache) -> Tensor:
    pairwise = v(_pairwise)
    uav = torch.arange(pairwise.shape[-1], device=pairwise.device)
    wanted = uav.unsqueeze(-1) if v.own_only else uav
    others = uav[:-1] + (uav[:-1] >= wanted.unsqueeze(-1))  # all but the UAV itself, in index order
    return pairwise.gather(-1, others.expand(*pairwise.shape[:-1], -1)).clamp(max=1)


@FEATURES.register("coverage")
@feature("global")
def _coverage(v: FeatureCache) -> Tensor:
    if v.context.footprints is None:
        raise ValueError("coverage needs the footprint tables")
    trail, points, known = v.messages.trail, v.context.points, v.context.coverage
    if v.own_only:
        return own_covered_share(v.context.footprints, trail, gather_rows(points, trail)).unsqueeze(-1)
    if known is not None and devices.data_dependent(trail.device):
        return updated_share(v.context.footprints, trail, points, known)
    return covered_share(v.context.footprints, trail, gather_rows(points, trail))


@FEATURES.register("mean_distance")
@feature("global")
def _mean_distance(v: FeatureCache) -> Tensor:
    n = v.messages.time.shape[-1]
    return (v(_pairwise).sum(-1) / max(n - 1, 1)).clamp(max=1)


@FEATURES.register("mean_distance_not_spotting")
@feature("global")
def _mean_distance_not_spotting(v: FeatureCache) -> Tensor:
    """Mean distance to the other UAVs that do not spot; 0 for a spotting UAV, or if there are no others."""
    silent = (~v.messages.spotted).to(v.scale.dtype)
    others = silent.sum(-1, keepdim=True) - 1
    total = (v(_pairwise) * silent.unsqueeze(-2)).sum(-1) * v.wanted(silent)
    return (total / others.clamp(min=1)).clamp(max=1)


@FEATURES.register("mean_distance_spotting")
@feature("global")
def _mean_distance_spotting(v: FeatureCache) -> Tensor:
    """Mean distance of the spotting UAVs to the source; 0 if no UAV spots."""
    spotting = v.messages.spotted.to(v.scale.dtype)
    total = (v(_raw_source_distance) * spotting).sum(-1, keepdim=True)
    mean = total / spotting.sum(-1, keepdim=True).clamp(min=1)
    return mean.clamp(max=1).expand_as(spotting)


@FEATURES.register("spotting_agents")
@feature("global")
def _spotting_agents(v: FeatureCache) -> Tensor:
    """Share of the UAVs that spot the source, N_ss / N."""
    spotting = v.messages.spotted.to(v.scale.dtype)
    return spotting.mean(-1, keepdim=True).expand_as(spotting)


@FEATURES.register("battery")
@feature("local")
def _battery(v: FeatureCache) -> Tensor:
    return observed(v.messages.battery, v.context.battery) / 100


@FEATURES.register("spotted")
@feature("local")
def _spotted(v: FeatureCache) -> Tensor:
    return v.messages.spotted.to(v.scale.dtype)


@FEATURES.register("age")
@feature("actor")
def _age(v: FeatureCache) -> Tensor:
    return (v.messages.age(v.context.now) / v.context.age_scale).clamp(max=1)


LOCAL, GLOBAL = tuple(feature_names("local")), tuple(feature_names("global"))
"""Names of the built-in features of the UAV itself, and of all UAVs (Table 2)."""
