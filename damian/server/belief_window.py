"""The beliefs of the latest steps, corrected as messages of these steps come in late.

A ring of slots holds, for each of the latest steps, the belief, and what the messages of that step report
with their delays. A message that comes in late changes what is known of its step; from there the filter runs
again. No message is later than the longest delay, so that older beliefs are final. The filter runs for a UAV
only from where it knows more than the server: before, their beliefs are one.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, get_type_hints

import torch
from torch import Tensor

from damian.common import devices
from damian.common.tensors import gather_rows
from damian.server.belief import (
    first_belief,
    likelihood,
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
    """Probability of each cell after the messages of the step, [S, V, B, K]."""
    shared: Tensor
    """Whether the belief of the receiver is that of the server, and lies only there, [S, V, B] bool."""
    report: Tensor
    """What the UAVs report in the step (``report_rows``), [S, N, B]."""
    delay: Tensor
    """The delay of these messages [steps], negative if they never arrive, [S, N, B]."""
    slot: Tensor
    """The slot of the latest step, [B]."""


def empty_window(grid: SourceGrid, longest: int, n_worlds: int, n_agents: int, own: bool) -> Window:
    """A window for messages that are at most ``longest`` steps late; ``own``: also for each UAV."""
    device, n_slots, n_viewers = grid.prior.device, longest + 2, 1 + n_agents * own
    belief = torch.ones(n_slots, n_viewers, n_worlds, grid.prior.shape[-1], device=device)
    report = torch.full((n_slots, n_agents, n_worlds), grid.no_report, device=device)
    shared = torch.ones(belief.shape[:-1], dtype=torch.bool, device=device)
    slot, delay = torch.zeros_like(report[0, 0]), torch.full_like(report, -1)
    return Window(belief, shared, report, delay, slot)


class Beliefs(NamedTuple):
    """Probability of each cell after the latest step."""

    server: Tensor
    """As the server believes, [B, K]."""
    own: Tensor
    """As each of the other receivers believes, [B, V - 1, K]."""


def begin(grid: SourceGrid, window: Window, messages: Messages, region: Tensor, mask: Tensor) -> Beliefs:
    """Begin new episodes in the worlds of the mask, in place.

    Args:
        grid: cells and tables.
        window: beliefs of the latest steps.
        messages: the first messages [B, N], which all receivers know at once.
        region: index of the region of each world, [B].
        mask: worlds that begin an episode, [B] bool.
    """
    report = report_rows(grid, messages, torch.ones_like(messages.spotted))
    _begin(*grid, *window, report, region, mask)
    return latest(window, window.slot)


def advance(
    grid: SourceGrid, window: Window, report: Tensor, delay: Tensor, region: Tensor, stepped: Tensor
) -> tuple[Tensor, Beliefs]:
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
        beliefs of that step.
    """
    slot, *beliefs = _advance(*grid, *window, report, delay, region, stepped)
    return slot, Beliefs(*beliefs)


def latest(window: Window, slot: Tensor) -> Beliefs:
    """The beliefs of a step, by its slot in each world, [B]."""
    viewer = torch.arange(window.belief.shape[1], device=slot.device)
    world = torch.arange(len(slot), device=slot.device).unsqueeze(-1)
    row, held = _row(window, slot.unsqueeze(-1), viewer, world), window.belief.flatten(0, 2)
    return Beliefs(held.index_select(0, row[:, 0]), gather_rows(held, row[:, 1:]))


# Operators of their own: the number of worlds to work on depends on data, which no compiler can trace.

_TYPES: dict[Any, str] = {Tensor: "Tensor", Tensor | None: "Tensor?", float: "float"}
_CHANGED = ("belief", "shared", "report", "delay")
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


@_operator("begin_belief", "Tensor first, Tensor region, Tensor mask", "()")
def _begin(*arguments: Any) -> None:
    grid, window, (first, region, mask) = _unpacked(arguments)
    (world,) = _chosen(mask)
    if not len(world):
        return
    begun, slot, known, region = (each.index_select(0, world) for each in (mask, window.slot, first, region))
    _write(window.belief, _row(window, slot, 0, world), first_belief(grid, known, region), begun)
    window.report.masked_fill_(mask, grid.no_report)  # nothing is in transit
    for held, new in ((window.shared, mask), (window.report, first), (window.delay, torch.zeros_like(first))):
        _write_step(held, window.slot, new.view(len(mask), -1).T, mask)


@_begin.register_fake
def _(*arguments: Any) -> None:
    pass


@_operator(
    "advance_belief",
    "Tensor sent, Tensor sent_delay, Tensor region, Tensor stepped",
    "(Tensor, Tensor, Tensor)",
)
def _advance(*arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
    grid, window, (sent, sent_delay, region, stepped) = _unpacked(arguments)
    n_slots = len(window.belief)
    slot = torch.where(stepped, (window.slot + 1) % n_slots, window.slot)
    _write_step(window.report, slot, sent.T, stepped)
    _write_step(window.delay, slot, sent_delay.T, stepped)
    back = (slot - torch.arange(n_slots, device=slot.device).unsqueeze(-1)) % n_slots
    for each in _to_compute(grid, window, back, _begins(grid, window, back, stepped), region):
        before = window.belief.flatten(0, 2).index_select(0, each.before)
        new = weigh(predict(grid, before, each.region), likelihood(grid, each.reports))
        _write(window.belief, each.row, new, each.mask)
    beliefs = latest(window, slot)
    return slot, beliefs.server, beliefs.own


@_advance.register_fake
def _(*arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
    window = _unpacked(arguments)[1]
    _, n_viewers, n_worlds, n_cells = window.belief.shape
    server, own = (n_worlds, n_cells), (n_worlds, n_viewers - 1, n_cells)
    return torch.empty_like(window.slot), window.belief.new_empty(server), window.belief.new_empty(own)


def _begins(grid: SourceGrid, window: Window, back: Tensor, stepped: Tensor) -> Tensor:
    """How long ago the first step was of which each receiver's belief must be computed, [V, B] steps.

    It is -1 where none must be. A UAV shares the server's belief as long as it did so in the step before and
    the server has all that the UAV has reported since; this is noted in place.

    Args:
        grid: cells and tables.
        window: beliefs of the latest steps.
        back: how long ago the step of each slot was, [S, B] steps.
        stepped: worlds that take a step, [B] bool.
    """
    sent, lag = window.report != grid.no_report, back.unsqueeze(1)
    arrives = (sent & (window.delay == lag)).amax(1)
    first = torch.where(stepped, (arrives * back).amax(0), -1).unsqueeze(0)
    if window.shared.shape[1] == 1:
        return first
    missing = sent & ((window.delay < 0) | (window.delay > lag))
    before = back.gather(0, first + 1).expand(1, *window.shared.shape[1:])  # the slot of the step before
    alone = ((missing * (lag + 1)).amax(0) - 1).minimum(first)
    alone = torch.where(window.shared.gather(0, before)[0, 1:], alone, first)
    begins = torch.cat([first, alone])
    window.shared.logical_or_(lag <= first).logical_and_(lag > begins)
    return begins


class _Computed(NamedTuple):
    """C beliefs that are computed from those of the step before."""

    before: Tensor
    """Rows of the beliefs of the step before in the flattened ring, [C]."""
    row: Tensor
    """Rows of the beliefs, [C]."""
    mask: Tensor
    """Which of them change, [C] bool."""
    region: Tensor
    """Index of the region, [C]."""
    reports: Tensor
    """What their receivers know of the step, as rows of ``SourceGrid.log_reports``, [C, N]."""


def _to_compute(
    grid: SourceGrid, window: Window, back: Tensor, begins: Tensor, region: Tensor
) -> Iterator[_Computed]:
    """The beliefs to compute, step by step, the oldest step first.

    Args:
        grid: cells and tables.
        window: beliefs of the latest steps.
        back: the slot of each step, by how long ago it was, [S, B].
        begins: how long ago the first step was, [V, B] steps.
        region: index of the region of each world, [B].
    """
    n_worlds, n_steps = begins.shape[1], len(back) - 1
    due = torch.arange(n_steps, device=back.device).view(-1, 1, 1) <= begins
    lag, viewer, world = _chosen(due)
    slot, earlier = (back.flatten().index_select(0, each * n_worlds + world) for each in (lag, lag + 1))
    receiver, agent = viewer * n_worlds + world, torch.arange(window.report.shape[1], device=back.device)
    at = (slot * len(agent) * n_worlds + world).unsqueeze(-1) + agent * n_worlds
    unknown = (window.delay < 0) | (window.delay > back.unsqueeze(1))
    known = window.report.maximum(unknown * grid.no_report)  # no report is the last row
    reports = gather_rows(_marked(grid, known).flatten(), at)
    if len(begins) > 1:
        own = gather_rows(_marked(grid, window.report).flatten(), at)
        reports = torch.where(viewer.unsqueeze(-1) == agent + 1, own, reports)
    work = _Computed(
        _row(window, earlier, viewer, world),
        slot * due[0].numel() + receiver,
        lag <= begins.flatten().index_select(0, receiver),
        region.index_select(0, world),
        reports,
    )
    counts = [due[0].numel()] * n_steps
    if devices.data_dependent(due.device):
        counts = lag.bincount().tolist()  # as far as the oldest step of any
    steps = zip(*(each.split(counts) for each in work), strict=True)
    return (_Computed(*each) for each in reversed([*steps]))


def _marked(grid: SourceGrid, reports: Tensor) -> Tensor:
    """The reports in a ring [S, N, B], with those marked that repeat the one of the slot before."""
    return repeated(grid, reports, reports.roll(1, 0))


def _row(window: Window, slot: Tensor, viewer: Tensor | int, world: Tensor) -> Tensor:
    """Where the belief of a receiver lies in the flattened ring, or that of the server, if it is shared.

    Args:
        window: beliefs of the latest steps.
        slot: of the step, [*].
        viewer: number of the receiver, [*].
        world: number of the world, [*].
    """
    n_viewers, n_worlds = window.shared.shape[1:]
    server = slot * n_viewers * n_worlds + world
    if n_viewers == 1:
        return server
    own = server + viewer * n_worlds
    return torch.where(gather_rows(window.shared.flatten(), own), server, own)


def _chosen(mask: Tensor) -> tuple[Tensor, ...]:
    """Indices at which a mask is true; all of them where shapes must not depend on data."""
    if devices.data_dependent(mask.device):
        return mask.nonzero(as_tuple=True)
    every = torch.meshgrid(*(torch.arange(n, device=mask.device) for n in mask.shape), indexing="ij")
    return tuple(each.flatten() for each in every)


def _write(held: Tensor, row: Tensor, new: Tensor, mask: Tensor) -> None:
    """Write beliefs into the ring in place.

    Args:
        held: the ring, [S, V, B, K].
        row: rows of the flattened ring, which ``_chosen`` has chosen, [C].
        new: their new values, [C, K].
        mask: which of them to change, [C] bool.
    """
    flat = held.flatten(0, 2)
    if devices.data_dependent(held.device):
        flat.numpy()[row.numpy()] = new.numpy()  # takes a third of the time of ``index_copy_``
    else:
        flat.index_copy_(0, row, torch.where(mask.unsqueeze(-1), new, flat.index_select(0, row)))


def _write_step(held: Tensor, slot: Tensor, new: Tensor, mask: Tensor) -> None:
    """Write values [N, B] into the slots [B] of a ring [S, N, B] in place, in the worlds of a mask [B]."""
    at = slot.expand(1, *held.shape[1:])
    held.scatter_(0, at, torch.where(mask, new, held.gather(0, at)))
