"""What a feature is: computed from messages, in a shape and range that it declares, under a
name."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from damian.common import checks
from damian.common.errors import InputError
from damian.common.registry import Registry
from damian.common.tensors import expand_mask
from damian.server.belief import SourceGrid, build_source_grids, first_belief, places, report_rows
from damian.server.config import ObservationConfig
from damian.server.layout import Layout
from damian.world.messages import Messages
from damian.world.signal_source import footprint_radius
from damian.world.simulation import Simulation

MakeTable = Callable[[Simulation, ObservationConfig], Any]
"""Makes what a feature looks up: tensors, or (nested) tuples and mappings of tensors, moved with
the device."""

Entries = tuple[str, ...] | Callable[[Simulation, ObservationConfig], tuple[str, ...]]
"""Names of values; a function, which is then among the feature's tables, where they depend on the
settings."""


class ServerContext(NamedTuple):
    """What the server knows besides the messages."""

    now: Tensor
    """Current time [s], [*]."""
    scale: Tensor
    """Largest vertex distance of the region [m], [*]."""
    time_scale: float
    """Times are divided by this [s]."""
    points: Tensor
    """Landing points by flat id, [R*L, 2] metres."""
    observation: ObservationConfig
    """Gives scales, and the numbers of landing points and steps that features look at."""
    dt: float = 1.0
    """Length of a step [s]."""
    n_points: int = 0
    """Largest number of landing points in a region, L."""
    radius: float | Tensor = 0.0
    """Radius of a UAV's footprint [m]; [*] if it is drawn."""
    level: Tensor | None = None
    """Number of the drawn level of the source, and so of the radius, in tables, [*]; None if none
    is drawn."""
    readings: Mapping[str, tuple[int, int]] = MappingProxyType({})
    """First column, and number of columns, of each reading in ``Messages.readings``, by name."""
    tables: Mapping[MakeTable, Any] = MappingProxyType({})
    """The tables that features declare, by the function that has made each."""
    belief: Tensor | None = None
    """Probability that each source is in each cell, [*, K, C]; None: as after these first
    messages."""
    timeline: Tensor | None = None
    """By sender and age in steps, where it is known to have stopped, east and north [m], what
    happened there (``Messages.events``), and 1, else zeros, [*, N, slots, 3 + E]; None: as after
    these first messages."""


def drawn_levels(simulation: Simulation) -> list[dict[str, float]]:
    """What the settings of a source are to be changed to, for each of its levels that may be drawn.

    Raises:
        InputError: the level is drawn from a range, for which no tables can be made.
    """
    levels = simulation.vehicles.values.choices.get("source.level_db", ())
    problem = "is a range, but coverage and beliefs have tables for each footprint"
    remedy = "give a list, as in [138,140,142]"
    checks.require(len(levels) != 2, "randomise.source.level_db", levels, f"{problem}: {remedy}")
    return [{"level_db": level} for level in levels] or [{}]


def footprint_radii(simulation: Simulation) -> list[float]:
    """The radius of a footprint for each level of the source that may be drawn [m]."""
    source = simulation.config.source
    return [footprint_radius(replace(source, **level)) for level in drawn_levels(simulation)]


def source_grid(simulation: Simulation, _: ObservationConfig) -> SourceGrid:
    """The cells in which the sources may be, with the tables of the belief for each level of the
    source."""
    levels = drawn_levels(simulation)
    kinds = [replace(each, **level) for level in levels for each in simulation.sources]
    grid = build_source_grids(simulation.airspace, kinds, simulation.dt)
    return grid._replace(first=grid.first.view(len(levels), -1))


class FeatureCache:
    """Messages, and intermediate results that several features share, each computed once and on
    demand.

    With ``own_only``, messages are [*, N, N] (receiver, sender), and of the values of UAV j that
    follow from what receiver i knows, only those with i = j are wanted.
    """

    def __init__(self, messages: Messages, context: ServerContext, own_only: bool = False) -> None:
        self.messages = messages
        self.context = context
        self.own_only = own_only
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
        receiver = sender - 1
        own = field.diagonal(0, receiver, sender).movedim(-1, receiver)
        return own.unsqueeze(sender)

    def scaled(self, ways: Tensor) -> Tensor:
        """Ways [*, ...] over half the largest vertex distance of the region."""
        return ways / expand_mask(self.context.scale / 2, ways)

    def reading(self, name: str) -> Tensor:
        """Values of a sensor of the settings (``damian.sensor``), [*, N] or, if several,
        [*, N, width]."""
        known = self.context.readings
        if name not in known:
            problem = "is missing: no sensor is given"
            if known:
                problem = f"is not one of {', '.join(known)}"
            raise InputError(f"sensors: {name}, which a feature reads, {problem}")
        first, width = known[name]
        values = self.messages.readings.narrow(-1, first, width)
        return values.squeeze(-1) if width == 1 else values

    def table(self, make: MakeTable) -> Any:
        """What ``make`` has made; the feature declares ``make`` among its tables."""
        if make not in self.context.tables:
            raise InputError(
                f"table {make.__name__}: declare it, as in @feature(..., tables=[{make.__name__}])"
            )
        return self.context.tables[make]

    @property
    def trail(self) -> Tensor:
        """Flat ids of the latest landing points that coverage counts, newest first,
        [*, N, window]."""
        return self.messages.trail[..., : self.context.observation.window]

    def tabled(self, point: Tensor) -> Tensor:
        """Ids in tables for each radius of footprints, from the flat ids of landing points
        [*, ...]."""
        level = self.context.level
        if level is None:
            return point
        return point + expand_mask(level, point) * len(self.context.points)

    @property
    def region(self) -> Tensor:
        """Index of the region, [*]."""
        return self.messages.region(self.context.n_points)

    @property
    def grid(self) -> SourceGrid:
        """Cells in which the sources may be."""
        if source_grid not in self.context.tables:
            raise InputError('belief: only a feature of scope "belief" may read it')
        return self.context.tables[source_grid]

    @property
    def belief(self) -> Tensor:
        """Probability that each source is in each cell of ``grid``, [*, K, C]."""
        return self(_belief)

    @property
    def radius(self) -> float | Tensor:
        """Radius of a UAV's footprint [m]; [*, 1, 1] if it is drawn."""
        radius = self.context.radius
        return radius[..., None, None] if isinstance(radius, Tensor) else radius

    @property
    def scale(self) -> Tensor:
        """Largest vertex distance of the region [m], [*, 1]."""
        return self.context.scale.unsqueeze(-1)


def _belief(v: FeatureCache) -> Tensor:
    """The belief of the context, or that after the first messages, [*, K, C]."""
    if v.context.belief is not None:
        return v.context.belief
    level = v.context.level
    rows = report_rows(v.grid, v.messages, level)
    return first_belief(v.grid, rows, places(v.grid, v.region, level))


class Feature(NamedTuple):
    """How a feature is computed, its shape and range, and who may observe it."""

    compute: Callable[[FeatureCache], Tensor]
    """From messages [*, N] to values [*, N, ...]."""
    scope: str
    """As in ``feature``; or ``timeline``, or ``actor``, which the critic never observes."""
    shape: tuple[int | None, ...] = ()
    """Shape of the values of a UAV; None where a size depends on the settings."""
    low: float = 0.0
    """Lowest possible value."""
    high: float = 1.0
    """Highest possible value."""
    entries: Entries = ()
    """What each value of the last dimension is."""
    rows: str = ""
    """What the first dimension lists, as in ``damian.server.layout.Block``."""
    tables: tuple[MakeTable, ...] = ()
    """What the feature looks up."""

    @property
    def meaning(self) -> str:
        """The feature's docstring, as one line."""
        return " ".join((self.compute.__doc__ or "").split())


def feature(
    scope: str,
    shape: Sequence[int | None] = (),
    low: float = 0.0,
    high: float = 1.0,
    name: str | None = None,
    *,
    entries: Sequence[str] | Callable = (),
    rows: str = "",
    tables: Sequence[MakeTable] = (),
) -> Callable[[Callable[[FeatureCache], Tensor]], Feature]:
    """Decorator that makes a feature of a function.

    The function reads ``cache.messages`` (fields [*, N]), ``cache.reading`` (your own sensors) and
    ``cache.context`` (time, scales, landing points), and must be pure, batched over * and, for
    ``env.compile()``, free of branches on data. ``cache(other)`` shares an intermediate result
    between features.

    Args:
        scope: ``local`` (follows from the UAV's own message alone: its actor sees that without
            delay where it knows its own messages), ``global`` (from the messages of all UAVs) or
            ``belief`` (from all messages so far, by ``cache.belief`` and ``cache.grid``).
        shape: shape of the values of one UAV: the function returns [*, N, *shape], for a single
            value [*, N]. A size that depends on the settings, such as the number of UAVs, is None.
        low, high: lowest and highest possible value; networks learn best from values about 1 in
            size.
        name: a short name under which settings know it, too.
        entries: what each value of the last dimension is.
        rows: what the first dimension lists, if it lists things whose order does not matter, such
            as ``others``; those that do not exist are zeros. Features that list the same have the
            same things in the same order.
        tables: functions of the simulation and the settings of the observation, each of which
            makes, once, something that the feature looks up by ``cache.table(function)``.

    Examples:
        >>> @feature("local")
        ... def track(cache):  # in lab.py, used as observation.local_features=[spotted,lab:track]
        ...     return cache.messages.track / (2 * math.pi)
    """
    checks.one_of("scope of a feature", scope, ("local", "global", "belief", "timeline", "actor"))
    looked_up = (*tables, source_grid) if scope == "belief" else tuple(tables)
    looked_up += (entries,) if callable(entries) else ()

    def declare(compute: Callable[[FeatureCache], Tensor]) -> Feature:
        named = entries if callable(entries) else tuple(entries)
        declared = Feature(compute, scope, tuple(shape), low, high, named, rows, looked_up)
        return FEATURES.register(name)(declared) if name else declared

    return declare


FEATURES = Registry[Feature](
    "feature", Feature, "is not a feature: decorate a function with damian.feature"
)
"""Features by name; those outside the package as ``package.module:name``."""


def feature_of(name: str) -> Feature:
    """The feature of a name or path, as it has been imported last."""
    return FEATURES[name] if name in FEATURES else FEATURES.get(name, "feature")


def check_features(config: ObservationConfig) -> None:
    """Require that every feature of an observation exists and has the scope in which it is used."""
    keys = {"local": "local_features", "global": "global_features", "belief": "belief"}
    for scope, key in keys.items():
        for name in getattr(config, key):
            found = FEATURES.get(name, f"observation.{key}")
            checks.require(
                found.scope == scope,
                f"observation.{key}",
                name,
                f"is a {found.scope} feature, not a {scope} one",
            )


def observe(messages: Messages, context: ServerContext, names: list[str]) -> dict[str, Tensor]:
    """Features by name of messages [*, N], each [*, N, ...] in the shape and range that it
    declares."""
    cache = FeatureCache(messages, context)
    found = {}
    for name in names:
        found[name] = cache(feature_of(name).compute)
        _check_shape(name, found[name], messages.time.shape)
    return found


def _check_shape(name: str, values: Tensor, uavs: torch.Size) -> None:
    """Require the values of a feature of UAVs [*, N] to have the shape that it declares."""
    declared = feature_of(name).shape
    several = values.shape[len(uavs) :]
    same = len(declared) == len(several) and values.shape[: len(uavs)] == uavs
    if not same or any(size not in (None, n) for size, n in zip(declared, several, strict=True)):
        expected = [*uavs, *declared]
        right = "(worlds, UAVs, values): return this shape, or declare another one"
        raise InputError(f"feature {name}: shape: {[*values.shape]} is not {expected} {right}")


def observe_own(known: Messages, context: ServerContext, names: list[str]) -> dict[str, Tensor]:
    """As ``observe``, but each UAV computes its own from messages [*, N, N] (receiver, sender)."""
    cache = FeatureCache(known, context, own_only=True)
    sender = known.time.dim() - 1
    found = {}
    for name in names:
        values = cache(feature_of(name).compute)
        if values.shape[sender] != 1:
            values = cache.wanted(values)
        found[name] = values.squeeze(sender)
    return found


def layout_of(
    features: Mapping[str, Tensor], names: Sequence[str], tables: Mapping[MakeTable, Any]
) -> Layout:
    """The layout of an observation of these features, from values [Q, N, ...] of each."""
    found = Layout()
    for name in names:
        declared = feature_of(name)
        found = found.appended(
            name,
            tuple(features[name].shape[2:]),
            declared.low,
            declared.high,
            meaning=declared.meaning,
            entries=tables[declared.entries] if callable(declared.entries) else declared.entries,
            rows=declared.rows,
        )
    return found


def stack(features: Mapping[str, Tensor], names: Sequence[str]) -> Tensor:
    """Observation vector in the order of ``names``, [*, N, F] float32, whatever the features' types
    are."""
    found = []
    for name in names:
        values = features[name]
        n_dims = len(feature_of(name).shape)
        found.append(values.flatten(-n_dims) if n_dims else values.unsqueeze(-1))
    return torch.cat(found, -1).float()
