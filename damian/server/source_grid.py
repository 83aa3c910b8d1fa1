"""What a server assumes of the source, on a grid of square cells: its place, its moves, and who detects it.

The cells are the same in all regions, about each region's local origin, so that the moves of the source are
one table; a region's prior tells which of the cells lie in it.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import shapely
import torch
from torch import Tensor

from damian.common import checks
from damian.common.tensors import tree_map
from damian.world.airspace import Airspace
from damian.world.signal_source import SourceConfig, draw_walks, locate

CELL = 0.8
"""Edge of a cell over the footprint's radius, if the settings do not give it."""
MOST_CELLS = 256
"""A cell whose edge the settings do not give is so large that there are no more cells than about this."""
DOUBT = 1e-3
"""Least probability that a UAV reports something else than the grid says: cells are not points."""
_SAMPLES = 6
"""Points along each edge of a cell at which detection is tested."""
_WALKS, _STEPS, _SEED = 512, 128, 0
"""Walks, and their steps, from which the moves are counted, and the seed with which they are drawn."""
_SPAN = 4
"""Number of steps over which a move is measured: a source that goes on straight gets further in them than
one that takes a new direction in each step, as the filter assumes."""
_RARE = 1e-6
"""Weight of a move that was never counted."""
_POINTS_AT_ONCE = 256


class SourceGrid(NamedTuple):
    """Cells in which the source may be, ``K`` of them, in ``R`` regions with ``L`` landing points each."""

    centres: Tensor
    """Centres of the cells, east, north [m], [K, 2]."""
    prior: Tensor
    """Share of each region's area that lies in each cell, [R, K]."""
    moves: Tensor | None
    """Weights of the source's moves in a step, from cell to cell, [K, K]; None if it does not move. If there
    is only one region, they are probabilities."""
    staying: Tensor
    """Sum of the weights of the moves from each cell that end in the region, [R, K]."""
    next_detection: Tensor
    """Probability that a UAV which lands on a landing point in the next step detects the source there, if the
    source is in a cell now, [R*L, K]."""
    next_staying: Tensor
    """The same for a UAV which stays where it is, [2*R*L + 1, K]. For the landing point of flat id p, row 2p:
    it detects nothing now; row 2p + 1: it detects the source now. The last row, of zeros: it is in flight."""
    log_reports: Tensor
    """Log-probability of what a UAV on a landing point reports if the source emits in a cell,
    [4*R*L + 1, K]. For the landing point of flat id p, row 2p: it detects nothing; row 2p + 1: it detects the
    source; 2*R*L further: the same, and so it did in the step before. The last row, of zeros: no report."""
    emits: float
    """Probability that the source emits in a step."""

    @property
    def no_report(self) -> int:
        """The row of ``log_reports`` that stands for no report."""
        return len(self.log_reports) - 1

    def to(self, device: torch.device) -> "SourceGrid":
        """Copy of the grid on another device."""
        return self._make(each.to(device) if isinstance(each, Tensor) else each for each in self)


def build_source_grid(
    airspace: Airspace, source: SourceConfig, radius: float, dt: float, cell: float | None = None
) -> SourceGrid:
    """Lay the grid over all regions, and tabulate what is known of the source.

    How it moves is counted from walks as the settings draw them, which are not those of any episode. Whether
    it emits is taken as drawn anew at every step: with ``emission=per_stop``, silence counts for too much.

    Args:
        airspace: regions and landing points.
        source: settings of the source.
        radius: radius of a UAV's footprint [m].
        dt: length of a step [s].
        cell: edge of a cell [m].

    Raises:
        InputError: the tables do not fit into memory.
    """
    polygons = [region.polygon for region in airspace.regions]
    area, n_points = max(polygon.area for polygon in polygons), airspace.points.shape[:2].numel()
    edge = cell or max(CELL * radius, math.sqrt(area / MOST_CELLS))
    n_cells = math.ceil(area / edge**2)  # at least
    size = 4 * n_cells * (8 * n_points + n_cells + 4 * len(polygons))
    checks.fits("observation.belief_cell", f"{edge:g} m", size, "take larger cells")
    columns = _columns(polygons, edge)
    centres = torch.as_tensor(columns * edge, dtype=torch.float32)
    squares = shapely.box(*(columns * edge - edge / 2).T, *(columns * edge + edge / 2).T)
    prior = torch.as_tensor(np.stack([shapely.area(shapely.intersection(squares, p)) for p in polygons]))
    prior = (prior / prior.sum(-1, keepdim=True)).float()
    moves, staying = None, torch.ones_like(prior)
    if source.motion == "dynamic":
        moves = _moves(columns, _displacements(polygons, source, dt) / edge)
        staying = (prior > 0).float() @ moves.T
        if len(polygons) == 1:
            moves = moves * (prior > 0) / staying.T
    shares = [
        _detected_shares(*each, columns * edge, edge, radius)
        for each in zip(polygons, airspace.points, strict=True)
    ]
    detects = DOUBT + (1 - 2 * DOUBT) * torch.cat(shares)
    log_reports = _log_reports(detects, source.emits, _renewed(centres, moves, edge))
    grid = SourceGrid(centres, prior, moves, staying, detects, detects, log_reports, source.emits)
    return grid._replace(next_detection=_one_step_before(grid, detects), next_staying=_staying(grid))


def _columns(polygons: list, edge: float) -> np.ndarray:
    """Column and row numbers of all cells that any of the polygons touches, [K, 2]."""
    bounds = np.array([polygon.bounds for polygon in polygons])
    first, last = np.floor(bounds[:, :2].min(0) / edge), np.ceil(bounds[:, 2:].max(0) / edge)
    axes = (np.arange(a, b + 1) for a, b in zip(first, last, strict=True))
    columns = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    squares = shapely.box(*((columns - 0.5) * edge).T, *((columns + 0.5) * edge).T)
    touched = np.zeros(len(columns), dtype=bool)
    for polygon in polygons:
        shapely.prepare(polygon)
        touched |= shapely.intersects(squares, polygon) & ~shapely.touches(squares, polygon)
    return columns[touched]


def _displacements(polygons: list, source: SourceConfig, dt: float) -> np.ndarray:
    """Moves of the source in steps of ``dt``, counted from walks, [S, 2] metres.

    Independent moves like these get as far in ``_SPAN`` steps as the source does.
    """
    rng, polygons = np.random.default_rng(_SEED), polygons[:_WALKS]
    source = replace(source, position=None)  # where it begins is not told
    time = torch.arange(_STEPS + 1, dtype=torch.float64) * dt
    found = []
    for polygon in polygons:
        walk = draw_walks(polygon, source, math.ceil(_WALKS / len(polygons)), rng)
        n_walks = len(walk.stop)
        every = tree_map(lambda t: t.repeat_interleave(len(time), 0), walk)
        place = locate(every, time.repeat(n_walks), source.after_walk == "loop").position
        place = place.view(n_walks, -1, 2)
        found.append((place[:, _SPAN:] - place[:, :-_SPAN]).reshape(-1, 2))
    return torch.cat(found).numpy() / math.sqrt(_SPAN)


def _moves(columns: np.ndarray, displacement: np.ndarray) -> Tensor:
    """Weight of each move from cell to cell, [K, K].

    The source is anywhere in its cell, and moves in any direction alike: the weights are averaged over the
    symmetries of a square.

    Args:
        columns: column and row number of each cell, [K, 2].
        displacement: moves of the source [cells], [S, 2].
    """
    reach = int(np.ptp(columns, axis=0).max())
    weight = np.full((2 * reach + 1, 2 * reach + 1), _RARE)
    near = displacement[(np.abs(displacement) < reach - 1).all(-1)] if reach > 1 else displacement[:0]
    whole = np.floor(near).astype(int)
    part = near - whole
    for dx, dy in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1])
        np.add.at(weight, (whole[:, 0] + dx + reach, whole[:, 1] + dy + reach), share / len(displacement))
    weight = np.mean([np.rot90(each, turns) for each in (weight, weight.T) for turns in range(4)], 0)
    offset = columns[None].astype(int) - columns[:, None].astype(int) + reach
    return torch.as_tensor(weight[offset[..., 0], offset[..., 1]], dtype=torch.float32)


def _renewed(centres: Tensor, moves: Tensor | None, edge: float) -> float:
    """How far the source moves in a step on average, in cells, at most 1; 0 if it does not move."""
    if moves is None:
        return 0.0
    mean = (moves * torch.cdist(centres, centres)).sum() / moves.sum()
    return min(float(mean) / edge, 1.0)


def _log_reports(detects: Tensor, emits: float, renewed: float) -> Tensor:
    """The table ``SourceGrid.log_reports``.

    A cell that a footprint covers in part would be ruled out by the same silence again and again, although a
    source that stays may be in its other part. So a repeated report counts only as far as the source may have
    moved since: with probability ``renewed`` it is anywhere in its cell, else it is where it was.

    Args:
        detects: probability of a detection if the source emits, [P, K].
        emits: probability that it emits.
        renewed: share of a cell by which it moves in a step.
    """
    silent = 1 - detects
    again = renewed * silent + (1 - renewed) * silent / (1 - emits * detects)
    fresh, repeated = (
        torch.stack(each, 1).flatten(0, 1)
        for each in ((silent, detects), (again, renewed * detects + 1 - renewed))
    )
    return torch.cat([fresh, repeated, torch.ones_like(fresh[:1])]).log()


def _one_step_before(grid: SourceGrid, chances: Tensor) -> Tensor:
    """Probability of a detection by the cell of the source one step before, [P, K].

    Args:
        grid: cells, moves and emission.
        chances: probability of the detection if the source emits in a cell, [P, K]; P is a multiple of R, and
            the same number of rows are of each region.
    """
    if grid.moves is None:
        return grid.emits * chances
    if len(grid.prior) == 1:
        return grid.emits * chances @ grid.moves.T
    inside = (grid.prior > 0).unsqueeze(1)
    by_region = chances.view(len(grid.prior), -1, chances.shape[-1]) * inside
    before = (by_region @ grid.moves.T) / grid.staying.unsqueeze(1)
    return grid.emits * before.view_as(chances)


def _staying(grid: SourceGrid) -> Tensor:
    """The table ``SourceGrid.next_staying``, from the repeated reports of ``SourceGrid.log_reports``."""
    again = grid.log_reports[grid.no_report // 2 : -1].exp()
    again[::2] = 1 - again[::2]
    again = _one_step_before(grid, again)
    return torch.cat([again, torch.zeros_like(again[:1])])


def _detected_shares(
    polygon: shapely.Geometry, points: Tensor, centres: np.ndarray, edge: float, radius: float
) -> Tensor:
    """Share of each cell's part of the polygon that lies in the footprint about each landing point, [L, K].

    Args:
        polygon: the region.
        points: its landing points, [L, 2] metres.
        centres: of the cells, [K, 2] metres.
        edge: of a cell [m].
        radius: of a footprint [m].
    """
    axis = ((np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5) * edge
    sample = centres[:, None] + np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    shapely.prepare(polygon)
    inside = shapely.contains_xy(polygon, sample[..., 0], sample[..., 1])
    inside |= ~inside.any(-1, keepdims=True)  # a corner of the region between the samples
    weight = torch.as_tensor(inside / inside.sum(-1, keepdims=True), dtype=torch.float32)
    sample = torch.as_tensor(sample.reshape(-1, 2), dtype=torch.float32)
    return torch.cat(
        [
            ((torch.cdist(part, sample) <= radius).view(len(part), *weight.shape) * weight).sum(-1)
            for part in points.nan_to_num(posinf=1e30).split(_POINTS_AT_ONCE)
        ]
    )
