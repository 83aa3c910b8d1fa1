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
from typing import NamedTuple

import numpy as np
import shapely
import torch
from torch import Tensor
from torch.nn import functional as F

from damian.common import devices
from damian.common.tensors import gather_rows, tree_map
from damian.world.airspace import Airspace
from damian.world.messages import Messages
from damian.world.signal_source import SourceConfig, draw_walks, footprint_radius, locate

# The grid: cells, and tables over them.

CELL = 0.8
"""Edge of a cell over the footprint's radius."""
MOST_CELLS = 256
"""Cells are larger where there would be more of them than about this."""
LEAST_REPORT_PROBABILITY = 1e-3
"""Least probability that a UAV reports something else than the grid says: cells are not points."""
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
    def n_fresh(self) -> int:
        """Rows of reports that repeat nothing, 2*P*L: by so many, the row of a repeated one is
        further."""
        return self.no_report // 2

    @property
    def n_points(self) -> int:
        """Largest number of landing points in a region, L."""
        fresh_in_place = self.n_fresh // len(self.prior)
        return fresh_in_place // 2


def build_source_grids(
    airspace: Airspace, sources: Sequence[SourceConfig], dt: float
) -> SourceGrid:
    """The grid of K sources: ``build_source_grid`` of each kind, with cells as for the faintest of
    them."""
    alike = [replace(each, position=None) for each in sources]
    kinds = [each for number, each in enumerate(alike) if each not in alike[:number]]
    radii = [footprint_radius(kind) for kind in kinds]
    edge = edge_of_cells(airspace, min(radii))
    grids = [
        build_source_grid(airspace, kind, radius, dt, edge)
        for kind, radius in zip(kinds, radii, strict=True)
    ]

    def joined(name: str, rows: slice = slice(None)) -> Tensor:
        return torch.cat([getattr(grid, name)[rows] for grid in grids])

    shared = grids[0]
    no_report = shared.log_reports[-1:]
    fresh = joined("log_reports", slice(shared.n_fresh))
    again = joined("log_reports", slice(shared.n_fresh, -1))
    stays = joined("next_staying", slice(-1))
    emits = joined("emits")
    moves = None
    if any(grid.moves is not None for grid in grids):
        still = torch.eye(len(shared.centres)).unsqueeze(0)
        moves = torch.cat([still if grid.moves is None else grid.moves for grid in grids])
    kind_of_source = torch.tensor([[kinds.index(each) for each in alike]])
    return SourceGrid(
        centres=shared.centres,
        prior=joined("prior"),
        moves=moves,
        staying=joined("staying"),
        next_detection=joined("next_detection"),
        next_staying=torch.cat([stays, no_report]),
        log_reports=torch.cat([fresh, again, no_report]),
        emits=emits if (emits < 1).any() else None,
        false_alarm=joined("false_alarm"),
        first=kind_of_source * len(airspace.regions),
    )


def edge_of_cells(airspace: Airspace, radius: float) -> float:
    """Edge of a cell [m], by the smallest ``radius`` of a footprint."""
    largest = max(region.polygon.area for region in airspace.regions)
    return max(CELL * radius, math.sqrt(largest / MOST_CELLS))


def build_source_grid(
    airspace: Airspace, source: SourceConfig, radius: float, dt: float, edge: float
) -> SourceGrid:
    """Lay the grid over all regions, and tabulate what is known of one source (lengths in metres).

    How it moves is counted from walks as the settings draw them. Whether it emits is taken as drawn
    anew at
    every step: with ``emission=per_stop``, silence counts for too much.
    """
    polygons = [region.polygon for region in airspace.regions]
    columns, prior = _cells(polygons, edge)
    positions = columns * edge
    centres = torch.as_tensor(positions, dtype=torch.float32)
    moves = None
    staying = torch.ones_like(prior)
    if source.motion == "dynamic":
        moves = _moves(columns, _displacements(polygons, source, dt) / edge)
        inside = prior > 0
        staying = inside.float() @ moves.T
        if len(polygons) == 1:
            moves = moves * inside / staying.T
            staying = torch.ones_like(prior)
    pairs = zip(polygons, airspace.points, strict=True)
    shares = torch.cat([_detected_shares(*each, positions, edge, radius) for each in pairs])
    covered = LEAST_REPORT_PROBABILITY + (1 - 2 * LEAST_REPORT_PROBABILITY) * shares
    reports = source.false_alarm + covered * (1 - source.miss - source.false_alarm)
    log_reports = _log_reports(covered, reports, source, _renewed(centres, moves, edge))
    repeated_rows = log_reports[len(log_reports) // 2 : -1]
    was_silent, reported = repeated_rows.exp().unflatten(0, (-1, 2)).unbind(1)
    if_it_stays = _in_turn(1 - was_silent, reported)
    stays = _one_step_before(source, prior, moves, staying, if_it_stays)
    detects = _one_step_before(source, prior, moves, staying, reports)
    by_place = torch.ones(len(polygons), dtype=torch.float64)
    return SourceGrid(
        centres=centres,
        prior=prior,
        moves=None if moves is None else moves.unsqueeze(0),
        staying=staying,
        next_detection=detects,
        next_staying=F.pad(stays, (0, 0, 0, 1)),
        log_reports=log_reports,
        emits=by_place * source.emits,
        false_alarm=by_place * source.false_alarm,
        first=torch.zeros(1, 1, dtype=torch.long),
    )


def _in_turn(after_silence: Tensor, after_report: Tensor) -> Tensor:
    """Rows 2p and 2p + 1 of a table, [2*R*L, C], from the rows p of two, [R*L, C] each."""
    return torch.stack([after_silence, after_report], 1).flatten(0, 1)


def _cells(polygons: list, edge: float) -> tuple[np.ndarray, Tensor]:
    """Column and row numbers of all cells with a part of any of the polygons, [C, 2], and the share
    of the area of each polygon that lies in each cell, [R, C]."""
    bounds = shapely.total_bounds(polygons) / edge
    south_west = np.floor(bounds[:2])
    north_east = np.ceil(bounds[2:])
    axes = [np.arange(a, b + 1) for a, b in zip(south_west, north_east, strict=True)]
    columns = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    positions = columns * edge
    half = edge / 2
    squares = shapely.box(*(positions - half).T, *(positions + half).T)
    parts = [shapely.intersection(squares, polygon) for polygon in polygons]
    area = torch.as_tensor(shapely.area(parts))
    touched = (area > 0).any(0)
    area = area[:, touched]
    share = area / area.sum(-1, keepdim=True)
    return columns[touched.numpy()], share.float()


def _displacements(polygons: list, source: SourceConfig, dt: float) -> np.ndarray:
    """Moves of the source in steps of ``dt``, counted from walks, [S, 2] metres."""
    # Independent moves like these get as far in STEPS_PER_MOVE steps as the source does.
    rng = np.random.default_rng(_SEED)
    polygons = polygons[:_WALKS]
    n_walks = math.ceil(_WALKS / len(polygons))
    time = torch.arange(_STEPS + 1, dtype=torch.float64) * dt
    loop = source.after_walk == "loop"
    found = []
    for polygon in polygons:
        walk = draw_walks(polygon, source, n_walks, rng)
        drawn = len(walk.stop)
        every = tree_map(lambda t: t.repeat_interleave(len(time), 0), walk)
        place = locate(every, time.repeat(drawn), loop).position
        place = place.view(drawn, -1, 2)
        moved = place[:, STEPS_PER_MOVE:] - place[:, :-STEPS_PER_MOVE]
        found.append(moved.reshape(-1, 2))
    return torch.cat(found).numpy() / math.sqrt(STEPS_PER_MOVE)


def _moves(columns: np.ndarray, displacement: np.ndarray) -> Tensor:
    """Weight of each move from cell to cell, [C, C], from moves [S, 2] in cells."""
    reach = int(np.ptp(columns, axis=0).max())
    width = 2 * reach + 1
    weight = np.full((width, width), _RARE)
    is_near = (np.abs(displacement) < reach - 1).all(-1)
    near = displacement[is_near]
    whole = np.floor(near).astype(int)
    part_x, part_y = (near - whole).T
    x, y = (whole + reach).T
    for dx, dy in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = np.abs(1 - dx - part_x) * np.abs(1 - dy - part_y)
        np.add.at(weight, (x + dx, y + dy), share / len(displacement))
    # The source moves in any direction alike: averaged over the symmetries of a square.
    mirrored = (weight, weight.T)
    turned = [np.rot90(each, turns) for each in mirrored for turns in range(4)]
    weight = np.mean(turned, 0)
    number = columns.astype(int)
    offset = number - number[:, None] + reach
    east, north = np.moveaxis(offset, -1, 0)
    return torch.as_tensor(weight[east, north], dtype=torch.float32)


def _renewed(centres: Tensor, moves: Tensor | None, edge: float) -> float:
    """How far the source moves in a step on average, in cells, at most 1; 0 if it does not move."""
    if moves is None:
        return 0.0
    way = torch.cdist(centres, centres)
    mean = (moves * way).sum() / moves.sum()
    return min(float(mean) / edge, 1.0)


def _log_reports(covered: Tensor, reports: Tensor, source: SourceConfig, renewed: float) -> Tensor:
    """The table ``SourceGrid.log_reports``, from the share of each cell that a footprint covers,
    and the probability of a report, [R*L, C] each.

    A source that stays may be in the part of its cell that a footprint does not cover. So a
    repeated report
    counts only as far as it may have moved: with probability ``renewed`` it is anywhere in its
    cell. Where it stays, reports in and out of reach are independent.
    """
    emits = source.emits
    miss = source.miss
    alarm = source.false_alarm
    silent = 1 - reports
    outside = 1 - covered
    quiet = 1 - alarm
    # Probabilities of silence and of a report one step before in reach; out of reach only alarms
    # are heard.
    was_silent = emits * miss + (1 - emits) * quiet
    reported = emits * (1 - miss) + (1 - emits) * alarm
    both_silent = covered * (miss * was_silent) + outside * quiet**2
    silent_before = quiet - emits * covered * (1 - miss - alarm)
    silent_again = renewed * silent + (1 - renewed) * both_silent / silent_before
    both_reported = covered * ((1 - miss) * reported) + outside * alarm**2
    reported_before = covered * reported + outside * alarm
    twice = both_reported / reported_before
    report_again = renewed * reports + twice - renewed * twice
    fresh = _in_turn(silent, reports)
    again = _in_turn(silent_again, report_again)
    no_report = torch.ones_like(fresh[:1])
    return torch.cat([fresh, again, no_report]).log()


def _one_step_before(
    source: SourceConfig, prior: Tensor, moves: Tensor | None, staying: Tensor, chances: Tensor
) -> Tensor:
    """Probability of a detection by the cell of the source one step before, from that by its cell,
    [*, C]."""
    alarm = (1 - source.emits) * source.false_alarm
    if moves is None:
        return source.emits * chances + alarm
    if len(prior) == 1:
        return source.emits * chances @ moves.T + alarm
    inside = (prior > 0).unsqueeze(1)
    by_region = chances.unflatten(0, (len(prior), -1))
    before = (by_region * inside @ moves.T) / staying.unsqueeze(1)
    return source.emits * before.view_as(chances) + alarm


def _detected_shares(
    polygon: shapely.Geometry, points: Tensor, centres: np.ndarray, edge: float, radius: float
) -> Tensor:
    """Share of each cell's part of the polygon in the footprint about each landing point,
    [L, C]."""
    axis = ((np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5) * edge
    offset = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    sample = centres[:, None] + offset
    shapely.prepare(polygon)
    inside = shapely.contains_xy(polygon, sample[..., 0], sample[..., 1])
    inside |= ~inside.any(-1, keepdims=True)  # a corner of the region between the samples
    share = inside / inside.sum(-1, keepdims=True)
    weight = torch.as_tensor(share, dtype=torch.float32)
    sampled = torch.as_tensor(sample.reshape(-1, 2), dtype=torch.float32)
    found = []
    for some in points.nan_to_num(posinf=1e30).split(256):
        reached = torch.cdist(some, sampled) <= radius
        reached = reached.view(len(some), *weight.shape)
        found.append((reached * weight).sum(-1))
    return torch.cat(found)


# The filter.

_LEAST = 1e-20
"""Added to every likelihood, so that reports which no cell makes possible change nothing."""


def repeated(grid: SourceGrid, rows: Tensor, before: Tensor) -> Tensor:
    """The rows, with those marked as repeated that are as ``before``, one step earlier; [*, N]
    each."""
    same = (rows == before) & (rows != grid.no_report)
    # It takes a third of the time of ``where``.
    return torch.add(rows, same, alpha=grid.n_fresh)


def places(grid: SourceGrid, region: Tensor, level: Tensor | None) -> Tensor:
    """Index of the tables of each source in the regions of worlds [*], [*, K].

    ``level`` [*]: numbers of the drawn levels; None if none is drawn.
    """
    first = grid.first[0 if level is None else level]
    return region.unsqueeze(-1) + first


def report_rows(
    grid: SourceGrid, messages: Messages, level: Tensor | None, sent: Tensor | bool = True
) -> Tensor:
    """The rows of messages [*, N], if ``sent`` in this step [*, N] bool, by source [*, K, N].

    A UAV in flight detects nothing. ``level`` is as in ``places``.
    """
    first = grid.first[0 if level is None else level] * grid.n_points
    point = messages.trail[..., 0].unsqueeze(-2) + first.unsqueeze(-1)
    row = 2 * point + messages.spots.movedim(-1, -2)
    tells = sent & ~messages.in_flight
    return torch.where(tells.unsqueeze(-2), row, grid.no_report)


def likelihood(grid: SourceGrid, rows: Tensor, place: Tensor) -> Tensor:
    """Probability of N reports of one step by the cell of the source, [*, C]."""
    # It gathers and sums at once.
    log = F.embedding_bag(rows.flatten(0, -2), grid.log_reports, mode="sum")
    match = log.exp_().view(*rows.shape[:-1], log.shape[-1])
    if grid.emits is not None:
        emits = gather_rows(grid.emits, place).unsqueeze(-1)
        alarm = gather_rows(grid.false_alarm, place).unsqueeze(-1)
        alarms = (rows % 2 == 1).sum(-1, True)  # the row of no report is even
        reports = (rows != grid.no_report).sum(-1, True)
        silences = reports - alarms
        if_mute = alarm.to(match) ** alarms * (1 - alarm).to(match) ** silences
        match = emits.to(match) * match + (1 - emits).to(match) * if_mute
    return match.add_(_LEAST)


def predict(grid: SourceGrid, belief: Tensor, place: Tensor) -> Tensor:
    """The belief one step later, before any message of that step, [*, C]."""
    if grid.moves is None:
        return belief
    if len(grid.prior) == 1:  # the moves are probabilities
        return belief @ grid.moves[0]
    stays = belief / gather_rows(grid.staying, place)
    n_regions = len(grid.prior) // len(grid.moves)
    kind = (place // n_regions).unsqueeze(-1)
    moved = stays @ grid.moves[0]
    for number in range(1, len(grid.moves)):
        moved = torch.where(kind == number, stays @ grid.moves[number], moved)
    inside = gather_rows(grid.prior, place) > 0
    return moved * inside


def weigh(predicted: Tensor, likely: Tensor) -> Tensor:
    """The belief after the messages of a step, from that before them and their ``likelihood``,
    [*, C]."""
    weighed = predicted * likely
    return weighed.div_(weighed.sum(-1, keepdim=True))


def first_belief(grid: SourceGrid, rows: Tensor, place: Tensor) -> Tensor:
    """The belief at the beginning of an episode, when everyone's first message is known, [*, C]."""
    prior = gather_rows(grid.prior, place)
    return weigh(prior, likelihood(grid, rows, place))


def certain_belief(grid: SourceGrid, source: Tensor) -> Tensor:
    """The belief of somebody who knows the place of the source, east, north [m], [*, 2]; [*, C]."""
    distance = torch.cdist(source.flatten(0, -2), grid.centres)
    certain = F.one_hot(distance.argmin(-1), len(grid.centres))
    return certain.to(source.dtype).unflatten(0, source.shape[:-1])


def detection_chance(grid: SourceGrid, belief: Tensor, place: Tensor) -> Tensor:
    """Probability, one step before, that a UAV detects the source on each landing point, [*, L]."""
    if len(grid.prior) == 1:
        return belief @ grid.next_detection.T
    by_place = grid.next_detection.unflatten(0, (len(grid.prior), -1))
    here = gather_rows(by_place, place)
    return (here @ belief.unsqueeze(-1)).squeeze(-1)


def chance_of_staying(grid: SourceGrid, belief: Tensor, rows: Tensor) -> Tensor:
    """Probability that a UAV which stays, now of report ``rows``, detects the source next,
    [*, N]."""
    chance = gather_rows(grid.next_staying, rows.clamp(max=grid.n_fresh))
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
    n_cells = len(grid.centres)
    belief = torch.ones(n_slots, n_viewers, n_beliefs, n_cells, device=device)
    report = torch.full((n_slots, n_agents, n_beliefs), grid.no_report, device=device)
    same = torch.ones_like(belief[..., 0], dtype=torch.bool)
    return Window(
        belief=belief,
        same_as_server=same,
        report=report,
        delay=torch.full_like(report, -1),
        slot=torch.zeros_like(report[0, 0]),
    )


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
    _, n_viewers, n_beliefs, _ = window.belief.shape
    viewer = torch.arange(n_viewers, device=slot.device)
    world = torch.arange(n_beliefs, device=slot.device).unsqueeze(-1)
    row = _row(window, slot.unsqueeze(-1), viewer, world)
    held = window.belief.flatten(0, 2)
    on_server = gather_rows(held, row[:, 0])
    return on_server, gather_rows(held, row[:, 1:])


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
    known = gather_rows(first, world)
    begun = first_belief(grid, known, gather_rows(place, world))
    row = _row(window, gather_rows(slot, world), 0, world)
    _write(window.belief, row, begun, gather_rows(mask, world))
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
    slots = torch.arange(n_slots, device=slot.device).unsqueeze(-1)
    slot_age = (slot - slots) % n_slots
    outdated = _first_outdated(grid, window, slot_age, stepped)
    held = window.belief.flatten(0, 2)
    work = _to_compute(grid, window, slot_age, outdated, place)
    for before, row, changes, within, reports in work:
        predicted = predict(grid, gather_rows(held, before), within)
        new = weigh(predicted, likelihood(grid, reports, within))
        _write(window.belief, row, new, changes)
    on_server, known = latest(window, slot)
    return slot, on_server, known


@_advance.register_fake
def _(tables, ring, slot, sent, sent_delay, place, stepped):
    belief = ring[0]
    _, n_viewers, n_worlds, n_cells = belief.shape
    server = belief.new_empty(n_worlds, n_cells)
    own = belief.new_empty(n_worlds, n_viewers - 1, n_cells)
    return torch.empty_like(slot), server, own


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
    oldest = (arrives * slot_age).amax(0)
    first = torch.where(stepped, oldest, -1).unsqueeze(0)
    same = window.same_as_server
    if same.shape[1] == 1:
        return first
    missing = sent & _unknown(window, slot_age)
    own_since = (missing * (age + 1)).amax(0) - 1
    own_since = own_since.minimum(first)
    before = slot_age.gather(0, first + 1)  # the slot of the step before
    was_same = same.take_along_dim(before.unsqueeze(0), 0)
    own_since = torch.where(was_same[0, 1:], own_since, first)
    outdated = torch.cat([first, own_since])
    same.logical_or_(age <= first).logical_and_(age > outdated)
    return outdated


def _unknown(window: Window, slot_age: Tensor) -> Tensor:
    """Whether the server does not have the messages of the steps, [S, N, B] bool; ages as above."""
    is_late = window.delay > slot_age.unsqueeze(1)
    return (window.delay < 0) | is_late


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
    n_beliefs = outdated.numel()  # in a slot
    steps = torch.arange(n_steps, device=slot_age.device)
    age, viewer, world = _chosen(steps.view(-1, 1, 1) <= outdated)
    slots = slot_age.flatten()
    at = age * n_worlds + world
    slot = gather_rows(slots, at)
    slot_before = gather_rows(slots, at + n_worlds)
    receiver = viewer * n_worlds + world
    agent = torch.arange(window.report.shape[1], device=slot.device)
    step_at = slot * len(agent) * n_worlds + world
    report_at = step_at.unsqueeze(-1) + agent * n_worlds

    def told(report: Tensor) -> Tensor:
        marked = repeated(grid, report, report.roll(1, 0))
        return gather_rows(marked.flatten(), report_at)

    no_report = _unknown(window, slot_age) * grid.no_report
    reports = told(window.report.maximum(no_report))  # no report is the last row
    if len(outdated) > 1:
        is_own = viewer.unsqueeze(-1) == agent + 1
        reports = torch.where(is_own, told(window.report), reports)
    before = _row(window, slot_before, viewer, world)
    row = slot * n_beliefs + receiver
    changes = age <= gather_rows(outdated.flatten(), receiver)
    counts = [n_beliefs] * n_steps
    if devices.data_dependent(slot_age.device):
        counts = age.bincount().tolist()  # as far as the oldest step of any
    work = (before, row, changes, gather_rows(place, world), reports)
    parts = [each.split(counts) for each in work]
    return reversed([*zip(*parts, strict=True)])


def _row(window: Window, slot: Tensor, viewer: Tensor | int, world: Tensor) -> Tensor:
    """Rows [*] of the flattened ring in which the beliefs of receivers lie; the server's where the
    same."""
    n_viewers, n_worlds = window.same_as_server.shape[1:]
    server = slot * n_viewers * n_worlds + world
    if n_viewers == 1:
        return server
    own = server + viewer * n_worlds
    same = gather_rows(window.same_as_server.flatten(), own)
    return torch.where(same, server, own)


def _chosen(mask: Tensor) -> tuple[Tensor, ...]:
    """Indices at which a mask is true; all of them where shapes must not depend on data."""
    if devices.data_dependent(mask.device):
        return mask.nonzero(as_tuple=True)
    axes = [torch.arange(n, device=mask.device) for n in mask.shape]
    every = torch.meshgrid(*axes, indexing="ij")
    return tuple(each.flatten() for each in every)


def _write(held: Tensor, row: Tensor, new: Tensor, mask: Tensor) -> None:
    """Write new values [M, C] into rows [M] of the flattened ring [S, V, B, C], where a mask [M] is
    true."""
    flat = held.flatten(0, 2)
    if devices.data_dependent(held.device):
        flat.numpy()[row.numpy()] = new.numpy()  # takes a third of the time of ``index_copy_``
    else:
        old = gather_rows(flat, row)
        flat.index_copy_(0, row, torch.where(mask.unsqueeze(-1), new, old))


def _write_step(held: Tensor, slot: Tensor, new: Tensor, mask: Tensor) -> None:
    """Write values [N, B] into the slots [B] of a ring [S, N, B] in place, where a mask [B] is
    true."""
    at = slot.expand(1, *held.shape[1:])
    old = held.gather(0, at)
    held.scatter_(0, at, torch.where(mask, new, old))
