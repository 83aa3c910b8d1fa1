"""Where the sources are, as far as messages tell: a Bayes filter of each over the cells of a grid.

``SourceGrid`` tabulates what a server assumes of the sources, the filter turns reports into
probabilities, and a ``Window`` repeats its latest steps when messages of them come in late: a
belief is exact for the messages that have arrived. All functions of the filter are pure and
batched.

A message tells which sources its UAV reports. Misses and false alarms of one source are drawn
independently
of those of the others: in each step, a listening UAV out of reach of a source reports that very
source with its probability ``false_alarm``. So what is reported of the others says nothing of a
source, and each one's filter is exact without them.

Everywhere, ``grid`` is a ``SourceGrid``, ``rows`` are rows of its table ``log_reports`` [*, N], a
``belief`` is the probability of each of its C cells [*, C], and ``place`` the index of a source's
table for its region (``places``) [*]. One of the dimensions * is that of the K sources.
"""

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import shapely
import torch
from torch import Tensor
from torch.nn.functional import embedding_bag, one_hot

from damian.common import checks, devices
from damian.common.tensors import gather_rows, tree_map
from damian.world.airspace import Airspace
from damian.world.messages import Messages
from damian.world.signal_source import SourceConfig, draw_walks, footprint_radius, locate

# The grid: cells, and tables over them.

CELL = 0.8
"""Edge of a cell over the footprint's radius, if the settings do not give it."""
MOST_CELLS = 256
"""A cell whose edge the settings do not give is so large that there are no more cells than about
this."""
LEAST_REPORT_PROBABILITY = 1e-3
"""Least probability that a UAV reports something else than the grid says: cells are not points."""
_MAX_CELLS = 10_000
"""Most cells: the table of moves has as many rows and columns."""
_SAMPLES = 6
"""Points along each edge of a cell at which detection is tested."""
_WALKS, _STEPS, _SEED = 512, 128, 0
"""Walks, and their steps, from which the moves are counted, and the seed with which they are
drawn."""
STEPS_PER_MOVE = 4
"""Steps over which a move is measured: straight moves get further than those that turn in each
step."""
_RARE = 1e-6
"""Weight of a move that was never counted."""


class SourceGrid(NamedTuple):
    """``C`` cells in which the sources may be, in ``R`` regions with ``L`` landing points each.

    Sources that are alike share their tables. The tables of each of G kinds of sources lie behind
    each other,
    as if they were of further regions: P = G R places.
    """

    centres: Tensor
    """Centres of the cells, east, north [m], [C, 2]."""
    prior: Tensor
    """Share of each region's area that lies in each cell, [P, C]."""
    moves: Tensor | None
    """Weights of a source's moves in a step, from cell to cell, [G, C, C]; None if none moves. If
    there is only one region, they are probabilities."""
    staying: Tensor
    """Sum of the weights of the moves from each cell that end in the region, [P, C]."""
    next_detection: Tensor
    """Probability that a UAV that lands next on a point detects the source in a cell now,
    [P*L, C]."""
    next_staying: Tensor
    """The same for one that stays, [2*P*L + 1, C]: row 2p if it detects nothing now on the landing
    point of flat id p, row 2p + 1 if it detects the source. The last row, of zeros: it is in
    flight."""
    log_reports: Tensor
    """Log-probability of what a UAV reports if the source emits in a cell, [4*P*L + 1, C]: rows as
    above;
    2*P*L further: the same, and so it did in the step before. The last row, of zeros: no report."""
    emits: Tensor | None
    """Probability that the source emits in a step, [P] in double precision; None if all always
    emit."""
    false_alarm: Tensor
    """Probability of a report from out of reach, [P] in double precision."""
    first: Tensor
    """Index of the first region's tables for each source, at each level that may be drawn,
    [V, K]."""

    @property
    def n_sources(self) -> int:
        """Number of sources, K."""
        return self.first.shape[-1]

    @property
    def no_report(self) -> int:
        """The row of ``log_reports`` that stands for no report."""
        return len(self.log_reports) - 1

    @property
    def n_points(self) -> int:
        """Largest number of landing points in a region, L."""
        return self.no_report // 4 // len(self.prior)


def build_source_grids(
    airspace: Airspace, sources: Sequence[SourceConfig], dt: float, cell: float | None = None
) -> SourceGrid:
    """The grid of K sources: ``build_source_grid`` of each kind, with cells as for the faintest of
    them."""
    alike = [replace(each, position=None) for each in sources]
    kinds = [each for number, each in enumerate(alike) if each not in alike[:number]]
    cell = cell or _edge(
        [region.polygon for region in airspace.regions], min(map(footprint_radius, kinds))
    )
    grids = [build_source_grid(airspace, kind, footprint_radius(kind), dt, cell) for kind in kinds]
    still = torch.eye(len(grids[0].centres)).unsqueeze(0)
    half = grids[0].no_report // 2
    moves = [still if each.moves is None else each.moves for each in grids]
    reports = [each.log_reports[rows] for rows in (slice(half), slice(half, -1)) for each in grids]
    by_place = ("prior", "staying", "next_detection", "emits", "false_alarm")
    joined: dict[str, Any] = {
        name: torch.cat([getattr(each, name) for each in grids]) for name in by_place
    }
    joined["emits"] = joined["emits"] if (joined["emits"] < 1).any() else None
    last = grids[0].log_reports[-1:]
    return grids[0]._replace(
        **joined,
        moves=None if all(each.moves is None for each in grids) else torch.cat(moves),
        next_staying=torch.cat(
            [*(each.next_staying[:-1] for each in grids), torch.zeros_like(last)]
        ),
        log_reports=torch.cat([*reports, last]),
        first=torch.tensor([[kinds.index(each) for each in alike]]) * len(airspace.regions),
    )


def _edge(polygons: list, radius: float) -> float:
    """Edge of a cell that the settings do not give [m]."""
    return max(CELL * radius, math.sqrt(max(polygon.area for polygon in polygons) / MOST_CELLS))


def build_source_grid(
    airspace: Airspace, source: SourceConfig, radius: float, dt: float, cell: float | None = None
) -> SourceGrid:
    """Lay the grid over all regions, and tabulate what is known of one source (lengths in metres).

    How it moves is counted from walks as the settings draw them. Whether it emits is taken as drawn
    anew at
    every step: with ``emission=per_stop``, silence counts for too much.
    """
    polygons = [region.polygon for region in airspace.regions]
    edge = cell or _edge(polygons, radius)
    n_cells = math.ceil(max(polygon.area for polygon in polygons) / edge**2)  # at least
    should = f"makes {n_cells} cells, more than {_MAX_CELLS}: take larger ones"
    checks.require(n_cells <= _MAX_CELLS, "observation.belief_cell", f"{edge:g} m", should)
    columns = _columns(polygons, edge)
    centres = torch.as_tensor(columns * edge, dtype=torch.float32)
    squares = shapely.box(*(columns * edge - edge / 2).T, *(columns * edge + edge / 2).T)
    prior = torch.as_tensor(
        np.stack([shapely.area(shapely.intersection(squares, p)) for p in polygons])
    )
    prior = (prior / prior.sum(-1, keepdim=True)).float()
    moves = None
    staying = torch.ones_like(prior)
    if source.motion == "dynamic":
        moves = _moves(columns, _displacements(polygons, source, dt) / edge)
        staying = (prior > 0).float() @ moves.T
        if len(polygons) == 1:
            moves = moves * (prior > 0) / staying.T
            staying = torch.ones_like(prior)
    pairs = zip(polygons, airspace.points, strict=True)
    shares = [_detected_shares(*each, columns * edge, edge, radius) for each in pairs]
    covered = LEAST_REPORT_PROBABILITY + (1 - 2 * LEAST_REPORT_PROBABILITY) * torch.cat(shares)
    log_reports = _log_reports(covered, source, _renewed(centres, moves, edge))
    reports = source.false_alarm + covered * (1 - source.miss - source.false_alarm)
    chances = torch.tensor([[source.emits], [source.false_alarm], [0]], dtype=torch.float64)
    emits, alarm, first = chances.expand(3, len(polygons))
    moves = None if moves is None else moves.unsqueeze(0)
    grid = SourceGrid(
        centres,
        prior,
        moves,
        staying,
        reports,
        reports,
        log_reports,
        emits,
        alarm,
        first[None, :1].long(),
    )
    again = log_reports[grid.no_report // 2 : -1].exp()
    again[::2] = 1 - again[::2]
    stays = _one_step_before(grid, source, again)
    return grid._replace(
        next_detection=_one_step_before(grid, source, reports),
        next_staying=torch.cat([stays, torch.zeros_like(stays[:1])]),
    )


def _columns(polygons: list, edge: float) -> np.ndarray:
    """Column and row numbers of all cells that any of the polygons touches, [C, 2]."""
    bounds = np.array([polygon.bounds for polygon in polygons])
    first = np.floor(bounds[:, :2].min(0) / edge)
    last = np.ceil(bounds[:, 2:].max(0) / edge)
    axes = (np.arange(a, b + 1) for a, b in zip(first, last, strict=True))
    columns = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    squares = shapely.box(*((columns - 0.5) * edge).T, *((columns + 0.5) * edge).T)
    touched = np.zeros(len(columns), dtype=bool)
    for polygon in polygons:
        shapely.prepare(polygon)
        touched |= shapely.intersects(squares, polygon) & ~shapely.touches(squares, polygon)
    return columns[touched]


def _displacements(polygons: list, source: SourceConfig, dt: float) -> np.ndarray:
    """Moves of the source in steps of ``dt``, counted from walks, [S, 2] metres."""
    # Independent moves like these get as far in STEPS_PER_MOVE steps as the source does.
    rng = np.random.default_rng(_SEED)
    polygons = polygons[:_WALKS]
    time = torch.arange(_STEPS + 1, dtype=torch.float64) * dt
    found = []
    for polygon in polygons:
        walk = draw_walks(polygon, source, math.ceil(_WALKS / len(polygons)), rng)
        every = tree_map(lambda t: t.repeat_interleave(len(time), 0), walk)
        place = locate(every, time.repeat(len(walk.stop)), source.after_walk == "loop").position
        place = place.view(len(walk.stop), -1, 2)
        found.append((place[:, STEPS_PER_MOVE:] - place[:, :-STEPS_PER_MOVE]).reshape(-1, 2))
    return torch.cat(found).numpy() / math.sqrt(STEPS_PER_MOVE)


def _moves(columns: np.ndarray, displacement: np.ndarray) -> Tensor:
    """Weight of each move from cell to cell, [C, C], from moves [S, 2] in cells."""
    reach = int(np.ptp(columns, axis=0).max())
    weight = np.full((2 * reach + 1, 2 * reach + 1), _RARE)
    near = (
        displacement[(np.abs(displacement) < reach - 1).all(-1)] if reach > 1 else displacement[:0]
    )
    whole = np.floor(near).astype(int)
    part = near - whole
    for dx, dy in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1])
        np.add.at(
            weight, (whole[:, 0] + dx + reach, whole[:, 1] + dy + reach), share / len(displacement)
        )
    # The source moves in any direction alike: averaged over the symmetries of a square.
    weight = np.mean(
        [np.rot90(each, turns) for each in (weight, weight.T) for turns in range(4)], 0
    )
    offset = columns[None].astype(int) - columns[:, None].astype(int) + reach
    return torch.as_tensor(weight[offset[..., 0], offset[..., 1]], dtype=torch.float32)


def _renewed(centres: Tensor, moves: Tensor | None, edge: float) -> float:
    """How far the source moves in a step on average, in cells, at most 1; 0 if it does not move."""
    if moves is None:
        return 0.0
    mean = (moves * torch.cdist(centres, centres)).sum() / moves.sum()
    return min(float(mean) / edge, 1.0)


def _log_reports(covered: Tensor, source: SourceConfig, renewed: float) -> Tensor:
    """The table ``SourceGrid.log_reports``, from the share of each cell that a footprint covers,
    [R*L, C].

    A source that stays may be in the part of its cell that a footprint does not cover. So a
    repeated report
    counts only as far as it may have moved: with probability ``renewed`` it is anywhere in its
    cell. Where it stays, reports in and out of reach are independent.
    """
    emits = source.emits
    miss = source.miss
    alarm = source.false_alarm
    known = 1 - miss - alarm
    reports = alarm + covered * known
    silent = 1 - reports
    # Probabilities of silence and of a report one step before in reach; out of reach only alarms
    # are heard.
    was_silent = emits * miss + (1 - emits) * (1 - alarm)
    reported = emits * (1 - miss) + (1 - emits) * alarm
    both = covered * (miss * was_silent) + (1 - covered) * (1 - alarm) ** 2
    again = renewed * silent + (1 - renewed) * both / (1 - alarm - emits * covered * known)
    twice = covered * ((1 - miss) * reported) + (1 - covered) * alarm**2
    twice = twice / (covered * reported + (1 - covered) * alarm)
    fresh = torch.stack([silent, reports], 1).flatten(0, 1)
    repeated = torch.stack([again, renewed * reports + twice - renewed * twice], 1).flatten(0, 1)
    return torch.cat([fresh, repeated, torch.ones_like(fresh[:1])]).log()


def _one_step_before(grid: SourceGrid, source: SourceConfig, chances: Tensor) -> Tensor:
    """Probability of a detection by the cell of the source one step before, from that by its cell,
    [*, C]."""
    alarm = (1 - source.emits) * source.false_alarm
    if grid.moves is None:
        return source.emits * chances + alarm
    if len(grid.prior) == 1:
        return source.emits * chances @ grid.moves[0].T + alarm
    inside = (grid.prior > 0).unsqueeze(1)
    by_region = chances.view(len(grid.prior), -1, chances.shape[-1]) * inside
    before = (by_region @ grid.moves[0].T) / grid.staying.unsqueeze(1)
    return source.emits * before.view_as(chances) + alarm


def _detected_shares(
    polygon: shapely.Geometry, points: Tensor, centres: np.ndarray, edge: float, radius: float
) -> Tensor:
    """Share of each cell's part of the polygon in the footprint about each landing point,
    [L, C]."""
    axis = ((np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5) * edge
    sample = centres[:, None] + np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    shapely.prepare(polygon)
    inside = shapely.contains_xy(polygon, sample[..., 0], sample[..., 1])
    inside |= ~inside.any(-1, keepdims=True)  # a corner of the region between the samples
    weight = torch.as_tensor(inside / inside.sum(-1, keepdims=True), dtype=torch.float32)
    sample = torch.as_tensor(sample.reshape(-1, 2), dtype=torch.float32)
    parts = [
        torch.cdist(part, sample) <= radius for part in points.nan_to_num(posinf=1e30).split(256)
    ]
    return torch.cat([(part.view(len(part), *weight.shape) * weight).sum(-1) for part in parts])


# The filter.

_LEAST = 1e-20
"""Added to every likelihood, so that reports which no cell makes possible change nothing."""


def repeated(grid: SourceGrid, rows: Tensor, before: Tensor) -> Tensor:
    """The rows, with those marked as repeated that are as ``before``, one step earlier; [*, N]
    each."""
    same = (rows == before) & (rows != grid.no_report)
    return torch.add(
        rows, same, alpha=grid.no_report // 2
    )  # takes a third of the time of ``where``


def places(grid: SourceGrid, region: Tensor, level: Tensor | None) -> Tensor:
    """Index of the tables of each source in the regions of worlds [*], [*, K].

    ``level`` [*]: numbers of the drawn levels; None if none is drawn.
    """
    return region.unsqueeze(-1) + grid.first[0 if level is None else level]


def report_rows(
    grid: SourceGrid, messages: Messages, level: Tensor | None, sent: Tensor | bool = True
) -> Tensor:
    """The rows of messages [*, N], if ``sent`` in this step [*, N] bool, by source [*, K, N].

    A UAV in flight detects nothing. ``level`` is as in ``places``.
    """
    first = grid.first[0 if level is None else level]
    point = messages.trail[..., 0].unsqueeze(-2) + (first * grid.n_points).unsqueeze(-1)
    row = 2 * point + messages.spots.movedim(-1, -2)
    return torch.where((sent & ~messages.in_flight).unsqueeze(-2), row, grid.no_report)


def likelihood(grid: SourceGrid, rows: Tensor, place: Tensor) -> Tensor:
    """Probability of N reports of one step by the cell of the source, [*, C]."""
    log = embedding_bag(
        rows.flatten(0, -2), grid.log_reports, mode="sum"
    )  # gathers and sums at once
    match = log.exp_().view(*rows.shape[:-1], log.shape[-1])
    if grid.emits is not None:
        reported = rows % 2 == 1  # the row of no report is even
        alarms = reported.sum(-1, True)
        reports = (rows != grid.no_report).sum(-1, True)
        emits, alarm = (
            gather_rows(each, place).unsqueeze(-1) for each in (grid.emits, grid.false_alarm)
        )
        silent = alarm.to(match) ** alarms * (1 - alarm).to(match) ** (reports - alarms)
        match = emits.to(match) * match + (1 - emits).to(match) * silent
    return match.add_(_LEAST)


def predict(grid: SourceGrid, belief: Tensor, place: Tensor) -> Tensor:
    """The belief one step later, before any message of that step, [*, C]."""
    if grid.moves is None:
        return belief
    if len(grid.prior) == 1:  # the moves are probabilities
        return belief @ grid.moves[0]
    stays = belief / gather_rows(grid.staying, place)
    kind = place // (len(grid.prior) // len(grid.moves))
    moved = stays @ grid.moves[0]
    for number in range(1, len(grid.moves)):
        moved = torch.where((kind == number).unsqueeze(-1), stays @ grid.moves[number], moved)
    return moved * (gather_rows(grid.prior, place) > 0)


def weigh(predicted: Tensor, likely: Tensor) -> Tensor:
    """The belief after the messages of a step, from that before them and their ``likelihood``,
    [*, C]."""
    weighed = predicted * likely
    return weighed.div_(weighed.sum(-1, keepdim=True))


def first_belief(grid: SourceGrid, rows: Tensor, place: Tensor) -> Tensor:
    """The belief at the beginning of an episode, when everyone's first message is known, [*, C]."""
    return weigh(gather_rows(grid.prior, place), likelihood(grid, rows, place))


def certain_belief(grid: SourceGrid, source: Tensor) -> Tensor:
    """The belief of somebody who knows the place of the source, east, north [m], [*, 2]; [*, C]."""
    nearest = torch.cdist(source.flatten(0, -2), grid.centres).argmin(-1)
    return one_hot(nearest, len(grid.centres)).to(source.dtype).unflatten(0, source.shape[:-1])


def detection_chance(grid: SourceGrid, belief: Tensor, place: Tensor) -> Tensor:
    """Probability, one step before, that a UAV detects the source on each landing point, [*, L]."""
    if len(grid.prior) == 1:
        return belief @ grid.next_detection.T
    here = gather_rows(grid.next_detection.view(len(grid.prior), -1, belief.shape[-1]), place)
    return (here @ belief.unsqueeze(-1)).squeeze(-1)


def chance_of_staying(grid: SourceGrid, belief: Tensor, rows: Tensor) -> Tensor:
    """Probability that a UAV which stays, now of report ``rows``, detects the source next,
    [*, N]."""
    chance = gather_rows(grid.next_staying, rows.clamp(max=len(grid.next_staying) - 1))
    return chance.mul_(belief.unsqueeze(-2)).sum(-1)


def any_of(chances: Tensor) -> Tensor:
    """Probability of any of independent events, from those of each [*, K, M], [*, M]."""
    return functools.reduce(lambda some, one: some + one - some * one, chances.unbind(-2))


@torch.library.custom_op("damian::entropy", mutates_args=())
def entropy(belief: Tensor) -> Tensor:
    """The entropy of each belief [*, C], in nats, [*]."""
    return belief.clamp(min=1e-12).log_().mul_(belief).sum(-1).neg_()


@entropy.register_fake
def _(belief: Tensor) -> Tensor:
    return belief.new_empty(belief.shape[:-1])


# The beliefs of the latest steps.


class Window(NamedTuple):
    """The latest steps, in a ring of S slots, of B beliefs of V receivers each: of each source in
    each world.

    A message that comes in late changes what is known of its step; from there the filter runs
    again. No message is later than the longest delay, so that older beliefs are final. The first
    receiver is the server. The others, if any, are the N UAVs. Each UAV knows its own messages at
    once, so that the filter runs for it only from where it knows more than the server.
    """

    belief: Tensor
    """Probability of each cell after the messages of the step, [S, V, B, C]."""
    same_as_server: Tensor
    """Whether the belief of the receiver is that of the server, and lies only there, [S, V, B]
    bool."""
    report: Tensor
    """What the UAVs report in the step (``report_rows``), [S, N, B]."""
    delay: Tensor
    """The delay of these messages [steps], negative if they never arrive, [S, N, B]."""
    slot: Tensor
    """The slot of the latest step, [B]."""


def empty_window(
    grid: SourceGrid, longest: int, n_beliefs: int, n_agents: int, own: bool
) -> Window:
    """A window for messages that are at most ``longest`` steps late; with ``own`` also for each
    UAV."""
    device = grid.prior.device
    n_slots = longest + 2
    n_viewers = 1 + n_agents * own
    belief = torch.ones(n_slots, n_viewers, n_beliefs, grid.prior.shape[-1], device=device)
    report = torch.full((n_slots, n_agents, n_beliefs), grid.no_report, device=device)
    same = torch.ones(belief.shape[:-1], dtype=torch.bool, device=device)
    slot = torch.zeros_like(report[0, 0])
    delay = torch.full_like(report, -1)
    return Window(belief, same, report, delay, slot)


Beliefs = tuple[Tensor, Tensor]
"""Probability of each cell after the latest step, as the server believes, [B, C], and as each of
the other receivers does, [B, V - 1, C]."""


def begin_beliefs(
    grid: SourceGrid, window: Window, report: Tensor, place: Tensor, mask: Tensor
) -> Beliefs:
    """Begin new episodes for the beliefs of the mask [B], in place; all receivers know the first
    reports."""
    _begin(*_parts(grid, window), report, place, mask)
    return latest(window, window.slot)


def advance_beliefs(
    grid: SourceGrid, window: Window, report: Tensor, delay: Tensor, place: Tensor, stepped: Tensor
) -> tuple[Window, Beliefs]:
    """Take one step of the beliefs ``stepped`` [B], and correct them by what arrives, in place.

    ``report`` [B, N]: what the messages of this step report (``report_rows``); ``delay`` [B, N]:
    their delays [steps], negative if they never arrive.
    """
    slot, on_server, own = _advance(*_parts(grid, window), report, delay, place, stepped)
    return window._replace(slot=slot), (on_server, own)


def latest(window: Window, slot: Tensor) -> Beliefs:
    """The beliefs of a step, by its slot in each world, [B]."""
    viewer = torch.arange(window.belief.shape[1], device=slot.device)
    world = torch.arange(len(slot), device=slot.device).unsqueeze(-1)
    row = _row(window, slot.unsqueeze(-1), viewer, world)
    held = window.belief.flatten(0, 2)
    return held.index_select(0, row[:, 0]), gather_rows(held, row[:, 1:])


# Custom operators, because the number of beliefs to compute depends on data, which no compiler can
# trace. An operator takes no named tuples, so grid and window come in parts: the tensors of the
# grid, those of the window that change, and its slot.

_Tables = list[Tensor | None]
_Ring = list[Tensor]


def _parts(grid: SourceGrid, window: Window) -> tuple[_Tables, _Ring, Tensor]:
    return list(grid), list(window[:-1]), window.slot


@torch.library.custom_op("damian::begin_belief", mutates_args=["ring"])
def _begin(
    tables: _Tables, ring: _Ring, slot: Tensor, first: Tensor, place: Tensor, mask: Tensor
) -> None:
    grid = SourceGrid._make(tables)
    window = Window._make([*ring, slot])
    (world,) = _chosen(mask)
    if not len(world):
        return
    begun, at, known, place = (each.index_select(0, world) for each in (mask, slot, first, place))
    _write(window.belief, _row(window, at, 0, world), first_belief(grid, known, place), begun)
    window.report.masked_fill_(mask, grid.no_report)  # nothing is in transit
    _write_step(window.same_as_server, slot, mask.unsqueeze(0), mask)
    _write_step(window.report, slot, first.T, mask)
    _write_step(window.delay, slot, torch.zeros_like(first.T), mask)


@_begin.register_fake
def _(tables, ring, slot, first, place, mask):
    pass


@torch.library.custom_op("damian::advance_belief", mutates_args=["ring"])
def _advance(
    tables: _Tables,
    ring: _Ring,
    slot: Tensor,
    sent: Tensor,
    sent_delay: Tensor,
    place: Tensor,
    stepped: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    grid = SourceGrid._make(tables)
    window = Window._make([*ring, slot])
    n_slots = len(window.belief)
    slot = torch.where(stepped, (slot + 1) % n_slots, slot)
    _write_step(window.report, slot, sent.T, stepped)
    _write_step(window.delay, slot, sent_delay.T, stepped)
    slot_age = (slot - torch.arange(n_slots, device=slot.device).unsqueeze(-1)) % n_slots
    outdated = _first_outdated(grid, window, slot_age, stepped)
    for before, row, changes, within, reports in _to_compute(
        grid, window, slot_age, outdated, place
    ):
        old = window.belief.flatten(0, 2).index_select(0, before)
        new = weigh(predict(grid, old, within), likelihood(grid, reports, within))
        _write(window.belief, row, new, changes)
    on_server, known = latest(window, slot)
    return slot, on_server, known


@_advance.register_fake
def _(tables, ring, slot, sent, sent_delay, place, stepped):
    _, n_viewers, n_worlds, n_cells = ring[0].shape
    server = (n_worlds, n_cells)
    own = (n_worlds, n_viewers - 1, n_cells)
    return torch.empty_like(slot), ring[0].new_empty(server), ring[0].new_empty(own)


def _first_outdated(grid: SourceGrid, window: Window, slot_age: Tensor, stepped: Tensor) -> Tensor:
    """How many steps ago the first step was after which each receiver's belief is outdated, or -1,
    [V, B].

    A UAV has the server's belief as long as it had it in the step before and the server has all
    that the UAV has reported since; this is noted in place. ``slot_age`` [S, B] tells how long ago
    each slot's step was, and is also the slot of the step that was so long ago.
    """
    sent = window.report != grid.no_report
    age = slot_age.unsqueeze(1)
    arrives = (sent & (window.delay == age)).amax(1)
    first = torch.where(stepped, (arrives * slot_age).amax(0), -1).unsqueeze(0)
    same = window.same_as_server
    if same.shape[1] == 1:
        return first
    missing = sent & ((window.delay < 0) | (window.delay > age))
    before = slot_age.gather(0, first + 1).expand(1, *same.shape[1:])  # the slot of the step before
    own_since = ((missing * (age + 1)).amax(0) - 1).minimum(first)
    own_since = torch.where(same.gather(0, before)[0, 1:], own_since, first)
    outdated = torch.cat([first, own_since])
    same.logical_or_(age <= first).logical_and_(age > outdated)
    return outdated


def _to_compute(
    grid: SourceGrid, window: Window, slot_age: Tensor, outdated: Tensor, place: Tensor
) -> Iterator[tuple[Tensor, ...]]:
    """The M beliefs to compute from those of the step before, step by step, the oldest step first.

    Yields the rows in the flattened ring of the beliefs before [M] and after [M], which change [M]
    bool, their places [M], and what their receivers know of the step, as rows of ``log_reports``
    [M, N].
    """
    n_worlds = outdated.shape[1]
    n_steps = len(slot_age) - 1
    due = torch.arange(n_steps, device=slot_age.device).view(-1, 1, 1) <= outdated
    age, viewer, world = _chosen(due)
    slot, earlier = (
        slot_age.flatten().index_select(0, each * n_worlds + world) for each in (age, age + 1)
    )
    receiver = viewer * n_worlds + world
    agent = torch.arange(window.report.shape[1], device=slot.device)
    at = (slot * len(agent) * n_worlds + world).unsqueeze(-1) + agent * n_worlds
    unknown = (window.delay < 0) | (window.delay > slot_age.unsqueeze(1))
    known = window.report.maximum(unknown * grid.no_report)  # no report is the last row
    reports = gather_rows(repeated(grid, known, known.roll(1, 0)).flatten(), at)
    if len(outdated) > 1:
        own = gather_rows(repeated(grid, window.report, window.report.roll(1, 0)).flatten(), at)
        reports = torch.where(viewer.unsqueeze(-1) == agent + 1, own, reports)
    before = _row(window, earlier, viewer, world)
    row = slot * due[0].numel() + receiver
    changes = age <= outdated.flatten().index_select(0, receiver)
    counts = [due[0].numel()] * n_steps
    if devices.data_dependent(due.device):
        counts = age.bincount().tolist()  # as far as the oldest step of any
    work = (before, row, changes, place.index_select(0, world), reports)
    return reversed([*zip(*(each.split(counts) for each in work), strict=True)])


def _row(window: Window, slot: Tensor, viewer: Tensor | int, world: Tensor) -> Tensor:
    """Rows [*] of the flattened ring in which the beliefs of receivers lie; the server's where the
    same."""
    n_viewers, n_worlds = window.same_as_server.shape[1:]
    server = slot * n_viewers * n_worlds + world
    if n_viewers == 1:
        return server
    own = server + viewer * n_worlds
    return torch.where(gather_rows(window.same_as_server.flatten(), own), server, own)


def _chosen(mask: Tensor) -> tuple[Tensor, ...]:
    """Indices at which a mask is true; all of them where shapes must not depend on data."""
    if devices.data_dependent(mask.device):
        return mask.nonzero(as_tuple=True)
    every = torch.meshgrid(
        *(torch.arange(n, device=mask.device) for n in mask.shape), indexing="ij"
    )
    return tuple(each.flatten() for each in every)


def _write(held: Tensor, row: Tensor, new: Tensor, mask: Tensor) -> None:
    """Write new values [M, C] into rows [M] of the flattened ring [S, V, B, C], where a mask [M] is
    true."""
    flat = held.flatten(0, 2)
    if devices.data_dependent(held.device):
        flat.numpy()[row.numpy()] = new.numpy()  # takes a third of the time of ``index_copy_``
    else:
        flat.index_copy_(0, row, torch.where(mask.unsqueeze(-1), new, flat.index_select(0, row)))


def _write_step(held: Tensor, slot: Tensor, new: Tensor, mask: Tensor) -> None:
    """Write values [N, B] into the slots [B] of a ring [S, N, B] in place, where a mask [B] is
    true."""
    at = slot.expand(1, *held.shape[1:])
    held.scatter_(0, at, torch.where(mask, new, held.gather(0, at)))
