"""The landing points nearest to any place, found among those of a few cells around it.

The nearest landing point is the one at the smallest distance in whole centimetres and, of several, the one
with the lowest id. Distances are computed in double precision about the region's own centre, so that which
points are equally near depends neither on rounding errors nor on where the coordinates begin.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from damian.common.tensors import gather_rows

_ID_BITS = 24
"""Bits of a landing point's id below its distance; a message cannot number more points either."""
RESOLUTION = 0.01
"""Landing points whose distances differ by less are not told apart [m]."""
_NEVER = torch.iinfo(torch.int64).max
_SLOTS, _SLOTS_LARGE = 2**18, 2**24
"""Distances computed at once, which bounds the memory: a few arrays of 2 MB, to stay in a CPU's cache; 128 MB
where all points are compared."""


class LandingGrid(NamedTuple):
    """The P landing points of R regions, sorted into C square cells; the cells of a row lie side by side."""

    place: Tensor
    """Places, by cell, [P, 2] metres, float64."""
    point: Tensor
    """Ids within their region, [P]."""
    first: Tensor
    """Index of the first point of each cell, and at last P, [C + 1]."""
    corner: Tensor
    """Lower left corner of each region's cells, [R, 2] metres, float64."""
    side: Tensor
    """Side of a region's cells, [R] metres, float64."""
    shape: Tensor
    """Number of columns and rows of a region's cells, [R, 2]."""
    first_cell: Tensor
    """Index of the first cell of each region, [R]."""

    def nearest(self, region: Tensor, target: Tensor, n: int) -> Tensor:
        """The ``n`` landing points nearest to each target, nearest first.

        Args:
            region: indices of the regions, [M].
            target: places, [M, 2] metres, float64.
            n: number of points.

        Returns:
            Ids within their region, [M, n]; -1 behind the last one of a region that has fewer than n.
        """
        found = region.new_full((len(region), n), -1)
        left, rings = torch.arange(len(region), device=region.device), 1
        while len(left):  # until every target has found its points
            left = self._search(region, target, left, rings, found)
            rings *= 2
        return found

    def nearest_of_all(self, region: Tensor, target: Tensor, n: int, n_points: int) -> Tensor:
        """As ``nearest``, but all points of the region are compared, so that no shape depends on data.

        Args:
            region: indices of the regions, [M].
            target: places, [M, 2] metres, float64.
            n: number of points.
            n_points: largest number of points of a region, at least n.
        """
        cells = self.shape.prod(-1)
        start = self.first[self.first_cell[region]].unsqueeze(-1)
        stop = self.first[(self.first_cell + cells)[region]].unsqueeze(-1)
        parts = [t.split(max(_SLOTS_LARGE // n_points, 1)) for t in (start, stop, target)]
        pieces = zip(*parts, strict=True)
        return torch.cat([_ids(self._best(a, b, n_points, part, n)) for a, b, part in pieces])

    def _search(self, region: Tensor, target: Tensor, wanted: Tensor, rings: int, found: Tensor) -> Tensor:
        """Find the points among ``rings`` rings of cells around the targets' own, part by part.

        Args:
            region: indices of the regions, [M].
            target: places, [M, 2].
            wanted: indices of the targets to search for.
            rings: number of rings.
            found: the result so far, [M, n], which is changed in place.

        Returns:
            Indices of the targets of which a nearer point may lie outside these cells.
        """
        start, stop, border = self._block(region[wanted], target[wanted], rings)
        width = max(int((stop - start).max()), 1)
        parts = [t.split(max(_SLOTS // (width * start.shape[1]), 1)) for t in (wanted, start, stop, border)]
        left = []
        for part, begin, end, clear in zip(*parts, strict=True):
            best = self._best(begin, end, width, target[part], found.shape[1])
            ids = _ids(best)
            found[part, : ids.shape[1]] = ids
            last = best[:, -1] if best.shape[1] == found.shape[1] else torch.full_like(best[:, -1], _NEVER)
            left.append(part[(last >> _ID_BITS >= 100 * clear - 1) & clear.isfinite()])
        return torch.cat(left)

    def _best(self, start: Tensor, stop: Tensor, width: int, target: Tensor, n: int) -> Tensor:
        """Numbers of ``_order`` of the points nearest to each target, smallest first.

        Args:
            start: index of the first point of each of C rows of cells, [M, C].
            stop: index of the one behind its last, [M, C].
            width: most points of a row of cells.
            target: [M, 2] metres.
            n: largest number of points.

        Returns:
            [M, n], or fewer columns if there are fewer points; ``_NEVER`` behind the last one.
        """
        slot = start.unsqueeze(-1) + torch.arange(width, device=start.device)
        real = (slot < stop.unsqueeze(-1)).flatten(1)
        slot = slot.flatten(1).clamp(max=len(self.place) - 1)
        order = _order(gather_rows(self.place, slot) - target.unsqueeze(1), gather_rows(self.point, slot))
        order = order.masked_fill_(~real, _NEVER)
        return order.topk(min(n, order.shape[1]), largest=False).values

    def _block(self, region: Tensor, target: Tensor, rings: int) -> tuple[Tensor, Tensor, Tensor]:
        """The points in the cell of each target and in ``rings`` rings of cells around it, row by row.

        Returns:
            Index of the first point of each row of cells, and of the one behind its last, both
            [M, 2 rings + 1]; distance from which on points may lie outside of the cells, infinite if there
            are no other cells, [M] metres.
        """
        corner, side, shape = self.corner[region], self.side[region].unsqueeze(-1), self.shape[region]
        cell = ((target - corner) / side).floor().long().clamp(min=0).minimum(shape - 1)
        low, high = (cell - rings).clamp(min=0), (cell + rings).minimum(shape - 1)
        before = torch.where(low > 0, target - corner - low * side, torch.inf)
        behind = torch.where(high < shape - 1, corner + (high + 1) * side - target, torch.inf)
        row = low[:, 1:] + torch.arange(2 * rings + 1, device=region.device)
        row_cell = self.first_cell[region].unsqueeze(-1) + row.minimum(high[:, 1:]) * shape[:, :1]
        start, stop = self.first[row_cell + low[:, :1]], self.first[row_cell + high[:, :1] + 1]
        stop = torch.where(row <= high[:, 1:], stop, start)
        return start, stop, torch.minimum(before, behind).amin(-1)


def build_grid(lattices: list[np.ndarray], areas: list[float], n: int) -> LandingGrid:
    """Sort landing points into cells, of such a size that the n nearest mostly lie in 3 x 3 of them.

    Args:
        lattices: landing points of each region, [L, 2] metres.
        areas: area of each region [m^2].
        n: number of points that will usually be asked for.
    """
    places, points, counts, shapes, sides, corners = [], [], [], [], [], []
    for lattice, area in zip(lattices, areas, strict=True):
        side = math.sqrt(n * area / len(lattice) / 2)
        corner = lattice.min(0)
        cell = ((lattice - corner) / side).astype(np.int64)
        shape = cell.max(0) + 1
        number = cell[:, 1] * shape[0] + cell[:, 0]
        order = np.argsort(number, kind="stable")
        places.append(lattice[order])
        points.append(order)
        counts.append(np.bincount(number, minlength=shape.prod()))
        shapes.append(shape)
        sides.append(side)
        corners.append(corner)
    first_cell = np.cumsum([0, *map(len, counts)])[:-1]
    first = np.cumsum(np.concatenate([[0], *counts]))
    fields = (np.concatenate(places), np.concatenate(points), first, np.stack(corners), np.array(sides))
    return LandingGrid(*map(torch.as_tensor, (*fields, np.stack(shapes), first_cell)))


def _ids(best: Tensor) -> Tensor:
    """Ids of the points of numbers of ``_order``, -1 for none, in the same shape."""
    return torch.where(best == _NEVER, -1, best & (1 << _ID_BITS) - 1)


def _order(offset: Tensor, point: Tensor) -> Tensor:
    """Number by which landing points are ranked: distance in whole centimetres, then id.

    A distance of half a centimetre is rounded up: the small term is far above rounding errors.

    Args:
        offset: from the target to the points, [*, 2] metres, float64.
        point: ids of the points, [*].
    """
    east, north = offset.unbind(-1)
    centimetres = (100 * (east * east + north * north).sqrt() + 0.500001).long()
    return (centimetres << _ID_BITS) + point
