"""What a feature reads: messages, and what the server knows besides them."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor

from damian.common.errors import InputError
from damian.server.belief import first_belief, report_rows
from damian.server.source_grid import SourceGrid
from damian.world.battery import BatteryConfig
from damian.world.coverage import FootprintTables, KnownCoverage
from damian.world.messages import Messages


class ServerContext(NamedTuple):
    """What the server knows besides the messages.

    Fields for features: ``now`` [s] and ``scale`` [m], [*], ``time_scale`` and ``age_scale`` [s], and
    ``points`` [m], [R*L, 2].
    """

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
    age_scale: float
    """Ages are divided by this [s]."""
    newest: bool = False
    """Estimate the source's position from only the newest detections (``ObservationConfig.estimate``)."""
    readings: Mapping[str, tuple[int, int]] = MappingProxyType({})
    """First column, and number of columns, of each reading in ``Messages.readings``, by name."""
    radius: float = 0.0
    """Radius of a UAV's footprint [m]."""
    n_points: int = 0
    """Largest number of landing points in a region, L."""
    goals: Tensor | None = None
    """For ``belief_gain``: the preferred landing points to which each discrete action may lead, as indices in
    their region, by the flat id of the landing point on which it begins, [C, R*L, A], C at most 2."""
    grid: SourceGrid | None = None
    """Cells in which the source may be; None if no feature reads the belief."""
    belief: Tensor | None = None
    """Probability that the source is in each cell, [*, K]; if not given, that after these messages, as if
    they were the first ones."""
    coverage: KnownCoverage | None = None
    """The coverage of an earlier step of the same worlds, [*]; None if all of it is to be computed."""


class FeatureCache:
    """Messages, and intermediate results that several features share, each computed once and on demand.

    Args:
        messages: of N UAVs, [*, N].
        context: with the leading dimensions [*] of the messages.
        own_only: messages are [*, N, N] (receiver, sender), and of the values of UAV j that follow from what
            receiver i knows, only those with i = j are wanted.
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
        """A field [*, N, ...] of the UAVs whose values are wanted: of all, or of one for each *, [*, 1, ...].

        A feature that compares every UAV with every other one computes only these, as [*, N, ...] or
        [*, 1, ...]; any other may compute all.
        """
        if not self.own_only:
            return field
        sender = self.context.now.dim()
        return field.diagonal(0, sender - 1, sender).movedim(-1, sender - 1).unsqueeze(sender)

    def reading(self, name: str) -> Tensor:
        """Values of a sensor of one's own (``damian.sensor``), [*, N], or [*, N, width] if it has several.

        Raises:
            InputError: the settings have no such sensor.
        """
        known = self.context.readings
        if name not in known:
            problem = f"is not one of {', '.join(known)}" if known else "is missing: no sensor is given"
            raise InputError(f"sensors: {name}, which a feature reads, {problem}")
        first, width = known[name]
        values = self.messages.readings.narrow(-1, first, width)
        return values.squeeze(-1) if width == 1 else values

    @property
    def region(self) -> Tensor:
        """Index of the region, [*]."""
        return self.messages.region(self.context.n_points)

    @property
    def grid(self) -> SourceGrid:
        """Cells in which the source may be.

        Raises:
            InputError: there are none, because no feature declares that it reads the belief.
        """
        if self.context.grid is None:
            raise InputError('belief: only a feature of scope "belief" may read it')
        return self.context.grid

    @property
    def belief(self) -> Tensor:
        """Probability that the source is in each cell of ``grid``, [*, K]."""
        return self(_belief)

    @property
    def scale(self) -> Tensor:
        """Largest vertex distance of the region [m], [*, 1]."""
        return self.context.scale.unsqueeze(-1)


def _belief(v: FeatureCache) -> Tensor:
    """The belief of the context, or that after the first messages, [*, K]."""
    if v.context.belief is not None:
        return v.context.belief
    rows = report_rows(v.grid, v.messages, torch.ones_like(v.messages.spotted))
    return first_belief(v.grid, rows, v.region)
