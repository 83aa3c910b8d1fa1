"""Features of messages: those of the paper's Table 2, and those of where the source is believed to be."""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor

from damian.common import checks, devices
from damian.common.errors import InputError
from damian.common.registry import Registry
from damian.common.tensors import distances, expand_mask, gather_rows
from damian.server.belief import (
    SourceGrid,
    any_of,
    chance_of_staying,
    detection_chance,
    entropy,
    first_belief,
    places,
    report_rows,
)
from damian.server.config import ObservationConfig
from damian.world.battery import BatteryConfig, observed
from damian.world.coverage import (
    FootprintTables,
    KnownCoverage,
    covered_share,
    own_covered_share,
    updated_share,
)
from damian.world.messages import Messages


class ServerContext(NamedTuple):
    """What the server knows besides the messages."""

    now: Tensor
    """Current time [s], [*]."""
    scale: Tensor
    """Largest vertex distance of the region [m], [*]."""
    time_scale: float
    """Times are divided by this [s]."""
    battery: BatteryConfig
    """Gives the resolution with which battery levels are observed."""
    footprints: FootprintTables | None
    """For the feature ``coverage``; None if it is not needed."""
    points: Tensor
    """Landing points by flat id, [R*L, 2] metres."""
    observation: ObservationConfig
    """Gives scales, and the numbers of landing points and steps that features look at."""
    dt: float = 1.0
    """Length of a step [s]."""
    readings: Mapping[str, tuple[int, int]] = MappingProxyType({})
    """First column, and number of columns, of each reading in ``Messages.readings``, by name."""
    radius: float | Tensor = 0.0
    """Radius of a UAV's footprint [m]; [*] if it is drawn."""
    footprint: Tensor | None = None
    """Number of the drawn radius in tables, [*]."""
    scaled_points: Tensor | None = None
    """Landing points for each radius that may be drawn, in the unit of the first one (``tables_of_all``)."""
    kinds: Tensor | None = None
    """Speed limit and battery capacity of each UAV, over the largest ones, [N, 2]."""
    n_points: int = 0
    """Largest number of landing points in a region, L."""
    goals: Tensor | None = None
    """For ``belief_gain``: landing points to which discrete actions lead, as ``Candidates.goals``."""
    places_inside: Tensor | None = None
    """For ``coverage_map``: whether the places about each landing point lie in its region, [R*L, 24], those
    for each radius behind each other."""
    grid: SourceGrid | None = None
    """Cells in which the sources may be; None if no feature reads the belief."""
    belief: Tensor | None = None
    """Probability that each source is in each cell, [*, K, C]; None: as after these first messages."""
    coverage: KnownCoverage | None = None
    """The coverage of an earlier step of the same worlds, [*]; None if all of it is to be computed."""


class FeatureCache:
    """Messages, and intermediate results that several features share, each computed once and on demand.

    With ``own_only``, messages are [*, N, N] (receiver, sender), and of the values of UAV j that follow from
    what receiver i knows, only those with i = j are wanted.
    """

    def __init__(self, messages: Messages, context: ServerContext, own_only: bool = False) -> None:
        self.messages, self.context, self.own_only = messages, context, own_only
        self._shared: dict[Callable, Tensor] = {}

    def __call__(self, compute: Callable[["FeatureCache"], Tensor]) -> Tensor:
        """The result of ``compute(self)``, from the cache after the first call."""
        if compute not in self._shared:
            self._shared[compute] = compute(self)
        return self._shared[compute]

    def wanted(self, field: Tensor) -> Tensor:
        """A field [*, N, ...] of the UAVs whose values are wanted: of all, or of one for each *."""
        if not self.own_only:
            return field
        sender = self.context.now.dim()
        return field.diagonal(0, sender - 1, sender).movedim(-1, sender - 1).unsqueeze(sender)

    def reading(self, name: str) -> Tensor:
        """Values of a sensor of the settings (``damian.sensor``), [*, N] or, if several, [*, N, width]."""
        known = self.context.readings
        if name not in known:
            problem = f"is not one of {', '.join(known)}" if known else "is missing: no sensor is given"
            raise InputError(f"sensors: {name}, which a feature reads, {problem}")
        first, width = known[name]
        values = self.messages.readings.narrow(-1, first, width)
        return values.squeeze(-1) if width == 1 else values

    @property
    def trail(self) -> Tensor:
        """Flat ids of the latest landing points that coverage counts, newest first, [*, N, window]."""
        return self.messages.trail[..., : self.context.observation.window]

    def tabled(self, point: Tensor) -> Tensor:
        """Ids in tables for each radius of footprints, from the flat ids of landing points [*, ...]."""
        number = self.context.footprint
        return point if number is None else point + expand_mask(number, point) * len(self.context.points)

    @property
    def region(self) -> Tensor:
        """Index of the region, [*]."""
        return self.messages.region(self.context.n_points)

    @property
    def grid(self) -> SourceGrid:
        """Cells in which the sources may be."""
        if self.context.grid is None:
            raise InputError('belief: only a feature of scope "belief" may read it')
        return self.context.grid

    @property
    def belief(self) -> Tensor:
        """Probability that each source is in each cell of ``grid``, [*, K, C]."""
        return self(_belief)

    @property
    def scale(self) -> Tensor:
        """Largest vertex distance of the region [m], [*, 1]."""
        return self.context.scale.unsqueeze(-1)


def _belief(v: FeatureCache) -> Tensor:
    """The belief of the context, or that after the first messages, [*, K, C]."""
    if v.context.belief is not None:
        return v.context.belief
    level = v.context.footprint
    return first_belief(v.grid, report_rows(v.grid, v.messages, level), places(v.grid, v.region, level))


class Feature(NamedTuple):
    """How a feature is computed, its shape and range, and who may observe it."""

    compute: Callable[[FeatureCache], Tensor]
    """From messages [*, N] to values [*, N] or, if it has several for each UAV, [*, N, width]."""
    scope: str
    """As in ``feature``; or ``timeline``, or ``actor``, which the critic never observes."""
    width: int | None = 1
    """Number of values for each UAV; None if it depends on the settings."""
    low: float = 0.0
    """Lowest possible value."""
    high: float = 1.0
    """Highest possible value."""


def feature(
    scope: str, width: int | None = 1, low: float = 0.0, high: float = 1.0, name: str | None = None
) -> Callable[[Callable[[FeatureCache], Tensor]], Feature]:
    """Decorator that makes a feature of a function.

    The function reads ``cache.messages`` (fields [*, N]), ``cache.reading`` (your own sensors) and
    ``cache.context`` (time, scales, landing points), and must be pure, batched over * and, for
    ``env.compile()``, free of branches on data. ``cache(other)`` shares an intermediate result between
    features.

    Args:
        scope: ``local`` (follows from the UAV's own message alone: its actor sees that without delay where it
            knows its own messages), ``global`` (from the messages of all UAVs) or ``belief`` (from all
            messages so far, by ``cache.belief`` and ``cache.grid``).
        width: number of values for each UAV. With 1 the function returns [*, N], with more [*, N, width];
            None if it depends on the number of UAVs.
        low, high: lowest and highest possible value; networks learn best from values about 1 in size.
        name: a short name under which settings know it, too.

    Examples:
        >>> @feature("local")
        ... def track(cache):  # in lab.py, used as observation.local_features=[spotted,lab:track]
        ...     return cache.messages.track / (2 * math.pi)
    """
    checks.one_of("scope of a feature", scope, ("local", "global", "belief", "timeline", "actor"))

    def declare(compute: Callable[[FeatureCache], Tensor]) -> Feature:
        declared = Feature(compute, scope, width, low, high)
        return FEATURES.register(name)(declared) if name else declared

    return declare


FEATURES = Registry[Feature]("feature", Feature, "is not a feature: decorate a function with damian.feature")
"""Features by name; those outside the package as ``package.module:name``."""


def feature_of(name: str) -> Feature:
    """The feature of a name or path, as it has been imported last."""
    return FEATURES[name] if name in FEATURES else FEATURES.get(name, "feature")


def check_features(config: ObservationConfig) -> None:
    """Require that every feature of an observation exists and has the scope in which it is used."""
    for scope, key in (("local", "local_features"), ("global", "global_features"), ("belief", "belief")):
        for name in getattr(config, key):
            found = FEATURES.get(name, f"observation.{key}")
            problem = f"is a {found.scope} feature, not a {scope} one"
            checks.require(found.scope == scope, f"observation.{key}", name, problem)


def observe(messages: Messages, context: ServerContext, names: list[str]) -> dict[str, Tensor]:
    """Features by name of messages [*, N], each [*, N], or in the shape and range that it declares."""
    cache, found = FeatureCache(messages, context), {}
    for name in names:
        declared = feature_of(name)
        found[name] = values = declared.compute(cache)
        several = values.shape[-1:] if declared.width is None else (declared.width,)
        columns = () if declared.width == 1 else several
        expected = [*messages.time.shape, *columns]
        if [*values.shape] != expected:
            right = "(worlds, UAVs, values): return this shape, or declare another width"
            raise InputError(f"feature {name}: shape: {[*values.shape]} is not {expected} {right}")
    return found


def observe_own(known: Messages, context: ServerContext, names: list[str]) -> dict[str, Tensor]:
    """As ``observe``, but each UAV computes its own from messages [*, N, N] (receiver, sender)."""
    cache, sender = FeatureCache(known, context, own_only=True), known.time.dim() - 1
    values = {name: feature_of(name).compute(cache) for name in names}
    return {
        name: (each if each.shape[sender] == 1 else cache.wanted(each)).squeeze(sender)
        for name, each in values.items()
    }


def stack(features: dict[str, Tensor], names: list[str]) -> Tensor:
    """Observation vector in the order of ``names``, [*, N, F] float32, whatever the features' types are."""
    values = [(features[name], feature_of(name).width) for name in names]
    return torch.cat([each.unsqueeze(-1) if width == 1 else each for each, width in values], -1).float()


def feature_bounds(features: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Lowest and highest possible values of features, each in the shape of the feature."""
    low = {name: torch.full(values.shape, feature_of(name).low) for name, values in features.items()}
    high = {name: torch.full(values.shape, feature_of(name).high) for name, values in features.items()}
    return low, high


# Table 2.


def _any_has_detected(v: FeatureCache) -> Tensor:
    """Whether any UAV has ever detected a source, [*, 1]."""
    return (v.messages.detected_time >= 0).flatten(-2).any(-1, keepdim=True)


def _to_source(v: FeatureCache) -> Tensor:
    """Vector from each UAV to the estimated position of the nearest known source [m], [*, N, 2]."""
    counts = v.messages.detected_time >= 0  # [*, N, K]
    weight = counts.to(v.messages.position.dtype)
    total = (v.messages.detected_position * weight.unsqueeze(-1)).sum(-3, keepdim=True)
    estimate = total / weight.sum(-2).clamp(min=1)[..., None, :, None]
    ways = estimate - v.messages.position.unsqueeze(-2)  # [*, N, K, 2]
    return nearest_way(ways, counts.any(-2, keepdim=True))


def nearest_way(ways: Tensor, known: Tensor | None = None) -> Tensor:
    """The shortest of ways [*, K, 2], of those that are ``known`` [*, K] if there are any, [*, 2]."""
    if ways.shape[-2] == 1:
        return ways.squeeze(-2)
    length = ways.square().sum(-1)
    length = length if known is None else length.masked_fill(~known, torch.inf)
    best = length.argmin(-1)[..., None, None]
    return ways.gather(-2, best.expand(*best.shape[:-1], 2)).squeeze(-2)


def _raw_source_distance(v: FeatureCache) -> Tensor:
    return torch.linalg.vector_norm(v(_to_source), dim=-1) / v.scale


def _bearing(v: FeatureCache) -> Tensor:
    """Bearing of the source, clockwise from north, [*, N] in (-pi, pi]."""
    east, north = v(_to_source).unbind(-1)
    # Within a millimetre of the source the bearing would be a rounding error: it is set to 0 (north).
    return torch.atan2(east, north) * (east.abs() + north.abs() > 1e-3)


def _pairwise(v: FeatureCache) -> Tensor:
    """Distances from the wanted UAVs to all, over the largest vertex distance of the region, [*, N, N]."""
    position = v.messages.position
    return distances(v.wanted(position), position) / v.scale.unsqueeze(-1)


def of_others(v: FeatureCache, pairs: Tensor) -> Tensor:
    """Values [*, N, N, F] of pairs of UAVs without those of a UAV with itself, [*, N, N-1, F].

    With ``own_only``, [*, N, 1, N, F] and [*, N, 1, N-1, F].
    """
    n = pairs.shape[-2]
    flat = pairs.flatten(-4 if v.own_only else -3, -2)
    # In rows of N + 1, all but the first of the diagonal are in the last column.
    different = flat[..., 1:, :].unflatten(-2, (n - 1, n + 1))[..., :-1, :]
    return different.reshape(*pairs.shape[:-2], n - 1, pairs.shape[-1])


@feature("global", name="source_distance")
def _source_distance(v: FeatureCache) -> Tensor:
    """Distance to the estimated source, over the largest vertex distance; 1 if it is unknown, [*, N]."""
    return torch.where(v(_any_has_detected), v(_raw_source_distance).clamp(max=1), 1.0)


@feature("global", name="source_bearing")
def _source_bearing(v: FeatureCache) -> Tensor:
    """Bearing of the estimated source, clockwise from north, in turns; 1 if it is unknown, [*, N]."""
    return torch.where(v(_any_has_detected), torch.remainder(v(_bearing) / (2 * math.pi), 1.0), 1.0)


@feature("global", name="source_drift")
def _source_drift(v: FeatureCache) -> Tensor:
    """((bearing - track) wrapped to [-pi, pi) + pi) / 2 pi: 0.5 if the UAV flies straight at the source."""
    turn = (v(_bearing) - v.messages.track) / (2 * math.pi)
    return torch.where(v(_any_has_detected), torch.remainder(turn + 0.5, 1.0), 1.0)


@feature("global", name="source_time")
def _source_time(v: FeatureCache) -> Tensor:
    """Time since any UAV detected the source, over ``observation.time_scale``; 1 if unknown, [*, N]."""
    latest = v.messages.detected_time.flatten(-2).amax(-1, keepdim=True)
    since = (v.context.now.unsqueeze(-1) - latest) / v.context.time_scale
    return torch.where(v(_any_has_detected), since.clamp(max=1), 1.0).expand_as(v.messages.time)


@feature("global", width=None, name="agent_distances")
def _agent_distances(v: FeatureCache) -> Tensor:
    """Distances to the other UAVs in their order, over the largest vertex distance, [*, N, N - 1]."""
    return of_others(v, v(_pairwise).unsqueeze(-1)).squeeze(-1).clamp(max=1)


@feature("global", name="coverage")
def _coverage(v: FeatureCache) -> Tensor:
    """Share of the UAV's latest footprints that is new and belongs to no other UAV, [*, N]."""
    assert v.context.footprints is not None
    trail, points, known = v.tabled(v.trail), v.context.points, v.context.coverage
    points = points if v.context.scaled_points is None else v.context.scaled_points
    if v.own_only:
        return own_covered_share(v.context.footprints, trail, gather_rows(points, trail)).unsqueeze(-1)
    if known is not None and devices.data_dependent(trail.device):
        known = known._replace(trail=v.tabled(known.trail))
        return updated_share(v.context.footprints, trail, points, known)
    return covered_share(v.context.footprints, trail, gather_rows(points, trail))


@feature("global", name="mean_distance")
def _mean_distance(v: FeatureCache) -> Tensor:
    """Mean distance to the other UAVs, over the largest vertex distance, [*, N]."""
    return (v(_pairwise).sum(-1) / max(v.messages.time.shape[-1] - 1, 1)).clamp(max=1)


@feature("global", name="mean_distance_not_spotting")
def _mean_distance_not_spotting(v: FeatureCache) -> Tensor:
    """Mean distance to the other UAVs that do not spot; 0 for a spotting UAV, or if there are no others."""
    silent = (~v.messages.spotted).to(v.scale.dtype)
    others = silent.sum(-1, keepdim=True) - 1
    total = (v(_pairwise) * silent.unsqueeze(-2)).sum(-1) * v.wanted(silent)
    return (total / others.clamp(min=1)).clamp(max=1)


@feature("global", name="mean_distance_spotting")
def _mean_distance_spotting(v: FeatureCache) -> Tensor:
    """Mean distance of the spotting UAVs to the source; 0 if no UAV spots."""
    spotting = v.messages.spotted.to(v.scale.dtype)
    total = (v(_raw_source_distance) * spotting).sum(-1, keepdim=True)
    mean = total / spotting.sum(-1, keepdim=True).clamp(min=1)
    return mean.clamp(max=1).expand_as(spotting)


@feature("global", name="spotting_agents")
def _spotting_agents(v: FeatureCache) -> Tensor:
    """Share of the UAVs that spot the source, N_ss / N."""
    spotting = v.messages.spotted.to(v.scale.dtype)
    return spotting.mean(-1, keepdim=True).expand_as(spotting)


@feature("local", name="battery")
def _battery(v: FeatureCache) -> Tensor:
    """Level of the battery, as a share, [*, N]."""
    return observed(v.messages.battery, v.context.battery) / 100


@feature("local", name="spotted")
def _spotted(v: FeatureCache) -> Tensor:
    """Whether the UAV detects the source, 0 or 1, [*, N]."""
    return v.messages.spotted.to(v.scale.dtype)


@feature("actor", name="age")
def _age(v: FeatureCache) -> Tensor:
    """Age of the UAV's message on the server, over ten seconds, [*, N]."""
    return (v.messages.age(v.context.now) / v.context.observation.age_scale).clamp(max=1)


# Where the sources are believed to be (``damian.server.belief``); beyond the paper's Table 2.

BELIEF_RINGS = (1.0, 3.0)
"""Outer radii of the inner rings of ``belief_map``, in footprint radii; the outermost ring has no end."""
BELIEF_SECTORS = 8
"""Sectors of ``belief_map``; the first one is centred on north, the others follow clockwise."""


@feature("belief", width=None, name="belief_gain")
def _belief_gain(v: FeatureCache) -> Tensor:
    """Probability of detecting any source next from where each discrete action leads, [*, N, A].

    Actions begin at the latest landing point, are taken to be flown at once, and lead to the nearest landing
    point, or to the second nearest if another UAV is known to stand there.
    """
    everyone, n_points = v.messages.trail[..., 0] % v.context.n_points, v.context.n_points
    standing, level = v.wanted(v.messages.trail[..., 0]), v.context.footprint
    rows = v.wanted(report_rows(v.grid, v.messages, level).movedim(-2, -1)).movedim(-1, -2)
    stays = any_of(chance_of_staying(v.grid, v.belief, rows)).unsqueeze(-1)
    chance = any_of(detection_chance(v.grid, v.belief, places(v.grid, v.region, level)))
    chance = chance.scatter(-1, everyone, -chance.gather(-1, everyone))  # negative where a UAV stands
    chance = chance.unsqueeze(-2).expand(*standing.shape, -1)
    chance = chance.scatter(-1, (standing % n_points).unsqueeze(-1), stays)
    goals = v.context.goals
    assert goals is not None
    nearest, second = (chance.gather(-1, gather_rows(each, standing)) for each in (goals[0], goals[-1]))
    return torch.where(nearest < 0, second.abs(), nearest).clamp(max=1)


@feature("belief", width=None, low=-1.0, name="belief_moments")
def _belief_moments(v: FeatureCache) -> Tensor:
    """Way to the mean place (east, north), spread (over the region's size), share of the largest entropy.

    These four of each source, [*, N, 4 K].
    """
    belief, centres = v.belief, v.grid.centres
    *mean, square = (belief @ torch.cat([centres, centres.square().sum(-1, True)], -1)).unbind(-1)
    mean = torch.stack(mean, -1)
    variance = (square - mean.square().sum(-1)).clamp(min=0)
    position = v.wanted(v.messages.position).unsqueeze(-2)
    offset = (mean.unsqueeze(-3) - position) / v.scale[..., None, None]  # [*, N, K, 2]
    unsure = entropy(belief) / math.log(max(belief.shape[-1], 2))
    shared = torch.stack([variance.sqrt() / v.scale, unsure], -1).unsqueeze(-3)
    return torch.cat([offset, shared.expand(*offset.shape[:-1], -1)], -1).clamp(-1, 1).flatten(-2)


@feature("belief", width=None, name="belief_map")
def _belief_map(v: FeatureCache) -> Tensor:
    """Probability that each source is in each sector of three rings about the UAV, [*, N, 24 K]."""
    position = v.wanted(v.messages.position)
    east, north = (v.grid.centres - position.unsqueeze(-2)).unbind(-1)  # [*, N, C]
    radius = v.context.radius
    distance = torch.hypot(east, north) / (radius[..., None, None] if isinstance(radius, Tensor) else radius)
    ring = sum((distance > edge).long() for edge in BELIEF_RINGS)
    turn = torch.atan2(east, north) / (2 * math.pi)
    part = ring * BELIEF_SECTORS + (turn * BELIEF_SECTORS).round().long() % BELIEF_SECTORS
    share = v.belief.unsqueeze(-3)
    share = share.expand(*part.shape[:-1], *share.shape[-2:])  # [*, N, K, C]
    bins = share.new_zeros(*share.shape[:-1], (len(BELIEF_RINGS) + 1) * BELIEF_SECTORS)
    return bins.scatter_add(-1, part.unsqueeze(-2).expand_as(share), share).clamp(max=1).flatten(-2)
