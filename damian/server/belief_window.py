"""The beliefs of the latest steps, corrected as messages of these steps come in late.

A ring of slots holds, for each of the latest steps, the belief, and what the messages of that step report
with their delays. A message that comes in late changes what is known of its step; from there the filter runs
again. No message is later than the longest delay, so that older beliefs are final.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, get_type_hints

import torch
from torch import Tensor

from damian.common import devices
from damian.common.tensors import expand_mask, gather_rows
from damian.server.belief import (
    evidence,
    first_belief,
    predict,
    repeated,
    report_rows,
    weigh,
)
from damian.server.source_grid import SourceGrid
from damian.world.messages import Messages


class Window(NamedTuple):
    """The ring, with S slots for B worlds and V receivers of the messages in each world.

    The first receiver is the server. If there are more, the others are the N UAVs, each of which knows its
    own messages at once.
    """

    belief: Tensor
    """Probability of each cell after the messages of the step, [S, B, V, K]."""
    report: Tensor
    """What the UAVs report in the step (``report_rows``), [S, B, N]."""
    delay: Tensor
    """The delay of these messages [steps], negative if they never arrive, [S, B, N]."""
    slot: Tensor
    """The slot of the latest step, [B]."""


def empty_window(grid: SourceGrid, longest: int, n_worlds: int, n_agents: int, own: bool) -> Window:
    """A window for messages that are at most ``longest`` steps late; ``own``: also for each UAV."""
    device, n_slots, n_viewers = grid.prior.device, longest + 2, 1 + n_agents * own
    belief = torch.ones(n_slots, n_worlds, n_viewers, grid.prior.shape[-1], device=device)
    report = torch.full((n_slots, n_worlds, n_agents), grid.no_report, device=device)
    slot, delay = torch.zeros_like(report[0, :, 0]), torch.full_like(report, -1)
    return Window(belief, report, delay, slot)


def begin(grid: SourceGrid, window: Window, messages: Messages, region: Tensor, mask: Tensor) -> Tensor:
    """Begin new episodes in the worlds of the mask, in place.

    Args:
        grid: cells and tables.
        window: beliefs of the latest steps.
        messages: the first messages [B, N], which all receivers know at once.
        region: index of the region of each world, [B].
        mask: worlds that begin an episode, [B] bool.

    Returns:
        The beliefs of the latest step, [B, V, K].
    """
    report = report_rows(grid, messages, torch.ones_like(messages.spotted))
    return _begin(*grid, *window, report, region, mask)


def advance(
    grid: SourceGrid, window: Window, report: Tensor, delay: Tensor, region: Tensor, stepped: Tensor
) -> tuple[Tensor, Tensor]:
    """Take one step: note what is sent, and correct the beliefs by what arrives, in place.

    Args:
        grid: cells and tables.
        window: beliefs of the latest steps; its ``slot`` is still that of the step before.
        report: what the messages of this step report (``report_rows``), [B, N].
        delay: their delays [steps], negative if they never arrive, [B, N].
        region: index of the region of each world, [B].
        stepped: worlds that take the step, [B] bool; nothing of the others changes.

    Returns:
        The slot of the latest step of each world, [B], by which the caller replaces ``Window.slot``, and the
        beliefs of that step, [B, V, K].
    """
    return _advance(*grid, *window, report, delay, region, stepped)


# Operators of their own: the number of worlds to work on depends on data, which no compiler can trace.

_TYPES: dict[Any, str] = {Tensor: "Tensor", Tensor | None: "Tensor?", float: "float"}
_CHANGED = ("belief", "report", "delay")
"""Tensors of the window that the operators change."""


def _operator(name: str, arguments: str, returns: str) -> Callable[[Callable], Any]:
    """Decorator that makes a function of grid, window and further arguments an operator ``damian::name``."""
    grid = [f"{_TYPES[kind]} {field}" for field, kind in get_type_hints(SourceGrid).items()]
    window = [f"Tensor(a{i}!) {f}" if f in _CHANGED else f"Tensor {f}" for i, f in enumerate(Window._fields)]
    schema = f"({', '.join([*grid, *window, arguments])}) -> {returns}"
    return torch.library.custom_op(f"damian::{name}", mutates_args=_CHANGED, schema=schema)


def _unpacked(arguments: tuple) -> tuple[SourceGrid, Window, tuple[Tensor, ...]]:
    """The grid, the window and the further arguments of an operator."""
    n_grid, n_both = len(SourceGrid._fields), len(SourceGrid._fields) + len(Window._fields)
    return SourceGrid(*arguments[:n_grid]), Window(*arguments[n_grid:n_both]), arguments[n_both:]


@_operator("begin_belief", "Tensor first, Tensor region, Tensor mask", "Tensor")
def _begin(*arguments: Any) -> Tensor:
    grid, window, (first, region, mask) = _unpacked(arguments)
    chosen, n_viewers = _chosen(mask), window.belief.shape[2]
    at = window.slot * len(mask) + torch.arange(len(mask), device=mask.device)
    known = first.index_select(0, chosen)
    new = first_belief(grid, known, region.index_select(0, chosen))
    _write(window.belief, at, new.unsqueeze(1).expand(-1, n_viewers, -1), mask, chosen)
    window.report.masked_fill_(mask.unsqueeze(-1), grid.no_report)  # nothing is in transit
    _write(window.report, at, known, mask, chosen)
    _write(window.delay, at, torch.zeros_like(known), mask, chosen)
    return _read(window.belief, at)


@_begin.register_fake
def _(*arguments: Any) -> Tensor:
    belief = _unpacked(arguments)[1].belief
    return belief.new_empty(belief.shape[1:])


@_operator(
    "advance_belief", "Tensor sent, Tensor sent_delay, Tensor region, Tensor stepped", "(Tensor, Tensor)"
)
def _advance(*arguments: Any) -> tuple[Tensor, Tensor]:
    grid, window, (sent, sent_delay, region, stepped) = _unpacked(arguments)
    n_slots, n_worlds = window.belief.shape[:2]
    latest = torch.where(stepped, (window.slot + 1) % n_slots, window.slot)
    lags = torch.arange(n_slots, device=latest.device).unsqueeze(-1)
    at = (latest - lags) % n_slots * n_worlds + torch.arange(n_worlds, device=latest.device)  # [S, B]
    _write(window.report, at[0], sent, stepped)
    _write(window.delay, at[0], sent_delay, stepped)
    changed = _changed(grid, window, at) & stepped
    changed[0] = stepped
    stale = torch.zeros_like(stepped)  # worlds whose beliefs change from the step with this lag on
    for lag in range(_oldest(changed), -1, -1):
        stale = stale | changed[lag]
        _filter(grid, window, lag, at, region, stale)
    return latest, _read(window.belief, at[0])


@_advance.register_fake
def _(*arguments: Any) -> tuple[Tensor, Tensor]:
    window = _unpacked(arguments)[1]
    return torch.empty_like(window.slot), window.belief.new_empty(window.belief.shape[1:])


def _changed(grid: SourceGrid, window: Window, at: Tensor) -> Tensor:
    """In which worlds a report has become known in this step that changes what is known of each step.

    Args:
        grid: cells and tables.
        window: beliefs of the latest steps.
        at: row of each step in the flattened ring, [S, B], the latest step first.

    Returns:
        A mask [S - 1, B].
    """
    report, delay = (gather_rows(held.flatten(0, 1), at) for held in (window.report, window.delay))
    lag = torch.arange(len(at), device=at.device).view(-1, 1, 1)
    arrives = ((delay == lag) & (report != grid.no_report)).any(-1)
    return arrives[:-1] | arrives[1:]  # a report also tells whether the next one is repeated


def _oldest(changed: Tensor) -> int:
    """The last row of ``changed`` [L, B] in which any is true; L - 1 where it must not depend on data."""
    if not devices.data_dependent(changed.device):
        return len(changed) - 1
    return max(changed.any(-1).nonzero().squeeze(-1).tolist(), default=0)


def _filter(grid: SourceGrid, window: Window, lag: int, at: Tensor, region: Tensor, worlds: Tensor) -> None:
    """Compute the belief of one step from that of the step before, in place.

    Args:
        grid: cells and tables.
        window: beliefs of the latest steps.
        lag: number of steps since the step.
        at: row of each step in the flattened ring, [S, B], the latest step first.
        region: index of the region of each world, [B].
        worlds: worlds in which the belief has changed, [B] bool.
    """
    chosen = _chosen(worlds)
    here, before, region = (each.index_select(0, chosen) for each in (at[lag], at[lag + 1], region))
    reports = repeated(grid, _known(grid, window, here, lag), _known(grid, window, before, lag + 1))
    new = predict(grid, _read(window.belief, before), region.unsqueeze(-1).expand(reports.shape[:-1]))
    new = weigh(grid, new, evidence(grid, reports))
    _write(window.belief, at[lag], new, worlds, chosen)


def _known(grid: SourceGrid, window: Window, rows: Tensor, lag: int) -> Tensor:
    """The reports of a step as far as they are known, as rows of ``SourceGrid.log_reports``, [C, V, N].

    Args:
        grid: cells and tables.
        window: beliefs of the latest steps.
        rows: row of the step in the flattened ring, [C].
        lag: number of steps since then.
    """
    report, delay = _read(window.report, rows), _read(window.delay, rows)
    known, n_viewers = ((delay >= 0) & (delay <= lag)).unsqueeze(1), window.belief.shape[2]
    if n_viewers > 1:
        own = torch.eye(n_viewers, n_viewers - 1, dtype=torch.bool, device=rows.device).roll(1, 0)
        known = known | own
    return torch.where(known, report.unsqueeze(1), grid.no_report)


def _read(held: Tensor, rows: Tensor) -> Tensor:
    """Rows of a flattened ring [S, B, ...]."""
    return held.flatten(0, 1).index_select(0, rows)


def _chosen(worlds: Tensor) -> Tensor:
    """Indices of the worlds of a mask [B]; of all of them where shapes must not depend on data."""
    if devices.data_dependent(worlds.device):
        return worlds.nonzero().squeeze(-1)
    return torch.arange(len(worlds), device=worlds.device)


def _write(held: Tensor, at: Tensor, new: Tensor, worlds: Tensor, chosen: Tensor | None = None) -> None:
    """Write into a ring [S, B, ...] in place, in the worlds of a mask.

    Args:
        held: the ring.
        at: row of each world in the flattened ring, [B].
        new: values of the worlds ``chosen``, of all if not given, [C, ...].
        worlds: the mask, [B] bool.
        chosen: ``_chosen(worlds)``.
    """
    flat = held.flatten(0, 1)
    if chosen is None:
        chosen = _chosen(worlds)
        new = new.index_select(0, chosen)
    rows = at.index_select(0, chosen)
    if not devices.data_dependent(at.device):
        new = torch.where(expand_mask(worlds, new), new, flat.index_select(0, rows))
    flat.index_copy_(0, rows, new.contiguous())
