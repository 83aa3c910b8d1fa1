"""Coverage: the share of a UAV's footprint that is new, lies in the region and belongs to no other
UAV.

A footprint is always sampled at the same ``64 * _WORDS`` points, so that a part of it is a bit mask.
Masks of
two kinds are tabulated once: the samples outside the polygon, for each landing point, and the
samples inside a second disc, for each offset of two discs. A step combines them with OR and counts
bits.
"""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
import torch
from torch import Tensor
from torch.nn import functional as F

from damian.world.regions.polygon import Area

_GRID = 321
"""Number of offsets from -2R to 2R along each axis; it is odd so that offset 0 is exact."""
_WORDS = 16
"""Words of a bit mask."""
_CHUNK_WORDS = 2**18
"""Words and table rows computed at once on a CPU: 2 MiB."""
_CHUNK_WORDS_LARGE = 2**24
"""The same on a GPU and in compiled graphs: 128 MiB."""
_POINTS_AT_ONCE = 1024
"""Landing points whose samples are tested at once, which bounds the memory: arrays of 16 MiB."""


class FootprintTables(NamedTuple):
    """Bit masks of a sampled footprint; a bit of 1 marks a sample that does not count.

    ``masks`` is ``[G * G + P, words]`` int64, for G offsets per axis and P landing points. Row ``x
    * G + y``: samples of a disc in a second disc, whose centre is ``(x - G // 2, y - G // 2)``
    cells further (east, north); 0 on the border. Row ``G * G + p``: samples of the disc at landing
    point p outside its polygon.
    """

    masks: Tensor
    cells_per_metre: float


def build_tables(polygons: Sequence[Area], points: np.ndarray, radius: float) -> FootprintTables:
    """Tabulate the masks of all landing points [R, L, 2] in polygons, for a ``radius`` of
    footprints [m].

    Over random polygons and up to 5 other discs, the error of one footprint's area
    is 0.2 % (rms) of pi R^2, and below 0.9 % in 3000 random placements; the worst placement that a
    search has found gives 1.1 %. Points of NaN are padding, where nothing counts as covered.
    """
    offsets = radius * _unit_disc_samples(64 * _WORDS)
    masks = [_overlap()]
    for polygon, places in zip(polygons, points, strict=True):
        masks.append(packed_bits(_outside(polygon, places, offsets)))
    return FootprintTables(torch.cat(masks), (_GRID - 1) / (4 * radius))


def tables_of_all(
    polygons: Sequence[Area],
    points: np.ndarray,
    radii: Sequence[float],
) -> FootprintTables:
    """The tables of several radii: the landing points of each follow as if they were further ones.

    Their positions are to be given in the unit of the first radius: times this one, over their own.
    """
    first, *others = [build_tables(polygons, points, radius) for radius in radii]
    of_points = [each.masks[_GRID**2 :] for each in others]
    return first._replace(masks=torch.cat([first.masks, *of_points]))


def covered_share(tables: FootprintTables, point_ids: Tensor, positions: Tensor) -> Tensor:
    """Coverage c_a in [0, 1], ``[*, N]``: mean share of each UAV's last n footprints that counts.

    The part of the footprint at ``positions[..., i, k, :]`` (index 0 newest) counts that lies
    inside the polygon, in the footprint of no other UAV at the same index k, and in no older
    footprint of UAV i itself. Shares are fractions of pi R^2 (paper, Table 2). ``point_ids``
    ``[*, N, n]`` are the landing points of the ``positions`` ``[*, N, n, 2]`` [m].
    """
    n_uavs, n_last = point_ids.shape[-2:]
    ids = point_ids.reshape(-1, n_uavs, n_last)
    cells = positions * tables.cells_per_metre
    cells = cells.reshape(*ids.shape, 2)
    # Windows that slide over the UAVs: i, i + 1, i + 2, ... (modulo N), without index tensors.
    twice = torch.cat([cells, cells[:, :-1]], 1)
    share = _share_of_first(tables, ids, twice.unfold(1, n_uavs, 1))
    return share.reshape(point_ids.shape[:-1])


def own_covered_share(tables: FootprintTables, point_ids: Tensor, positions: Tensor) -> Tensor:
    """The diagonal of ``covered_share`` of what each UAV knows, ``[*, N, N, ...]``
    (receiver, sender)."""
    n_uavs, n_last = point_ids.shape[-2:]
    uav = torch.arange(n_uavs, device=point_ids.device)
    receiver = uav.unsqueeze(-1)
    # The receiver i itself, then i + 1, i + 2, ... (modulo N).
    sender = (receiver + uav) % n_uavs
    pair = (receiver * n_uavs + sender).flatten()
    itself = uav * (n_uavs + 1)
    ids = point_ids.reshape(-1, n_uavs**2, n_last)
    own = ids.index_select(1, itself)
    cells = positions * tables.cells_per_metre
    cells = cells.reshape(*ids.shape, 2).index_select(1, pair)
    fleets = cells.view(-1, n_uavs, n_uavs, n_last, 2).movedim(2, -1)
    return _share_of_first(tables, own, fleets).reshape(point_ids.shape[:-2])


def _share_of_first(tables: FootprintTables, point_ids: Tensor, fleets: Tensor) -> Tensor:
    """Coverage of the first UAV of each fleet, ``[b, N]``, from positions in cells,
    ``[b, N, n, 2, N]``."""
    n_uavs, n_last = point_ids.shape[1:]
    words = tables.masks.shape[-1]
    n_masks = n_uavs + n_last - 1
    words_per_world = n_uavs * n_last * (n_masks + words)
    n_words = _CHUNK_WORDS
    if point_ids.device.type != "cpu" or torch.compiler.is_compiling():
        n_words = _CHUNK_WORDS_LARGE
    at_once = max(1, n_words // words_per_world)
    n_samples = 64 * n_last * words
    shares = []
    for ids, fleet in zip(point_ids.split(at_once), fleets.split(at_once), strict=True):
        outside = (ids + _GRID**2).unsqueeze(0)
        overlaps = _overlap_rows(fleet).movedim(-1, 0)
        rows = torch.cat([outside, overlaps])
        masks = _or_rows(tables.masks, rows.flatten(1))
        counts = bit_count(masks.view(*ids.shape[:-1], -1))
        # Summed as floats (exact: small integers), which compiles to a much faster loop than int64.
        lost = counts.sum(-1, dtype=fleet.dtype)
        shares.append(1 - lost / n_samples)
    return torch.cat(shares)


def _overlap_rows(fleet: Tensor) -> Tensor:
    """Table rows of the discs that may overlap a footprint of the first UAV,
    ``[b, N, n, N + n - 2]``."""
    # First the other UAVs at the same index, then the UAV itself at later ones; a window that
    # slides over the indices leaves out all other pairs, without index tensors.
    cells = fleet[..., 0]
    n_last = fleet.shape[-3]
    padded = F.pad(cells, (0, 0, 0, n_last - 1), value=math.inf)
    past = padded.unfold(-2, n_last, 1)
    other = torch.cat([fleet[..., 1:], past[..., 1:]], -1)
    # Adding half a cell before truncation rounds to the nearest one.
    corner = cells - _GRID / 2
    offset = other - corner.unsqueeze(-1)
    x, y = offset.clamp(0, _GRID - 1).long().unbind(-2)
    return x * _GRID + y


def _or_rows(table: Tensor, rows: Tensor) -> Tensor:
    """Bitwise OR of M rows of a table [R, words] for each of K sets of them: ``[M, K]`` ->
    ``[K, words]``."""
    first, *others = rows.unbind(0)
    combined = table.index_select(0, first)
    for row in others:
        combined |= table.index_select(0, row)
    return combined


def bit_count(words: Tensor) -> Tensor:
    """Number of 1 bits of each int64 (H. S. Warren, Hacker's Delight, 2nd ed., 5-1)."""
    # The shift repeats the sign bit, hence a mask after each.
    upper_ones = (words >> 1).bitwise_and_(0x5555555555555555)
    twos = words - upper_ones
    upper_twos = (twos >> 2).bitwise_and_(0x3333333333333333)
    fours = upper_twos.add_(twos & 0x3333333333333333)
    sums = (fours >> 4).add_(fours)
    eights = sums.bitwise_and_(0x0F0F0F0F0F0F0F0F)
    return eights.mul_(0x0101010101010101) >> 56


def _unit_disc_samples(count: int) -> np.ndarray:
    """Well-spread points of equal weight in the unit disc, ``[count, 2]`` (H. Vogel, 1979)."""
    k = np.arange(count)
    r = np.sqrt((k + 0.5) / count)
    angle = k * np.pi * (3 - math.sqrt(5))
    x = r * np.cos(angle)
    y = r * np.sin(angle)
    return np.stack([x, y], -1)


def _outside(polygon: shapely.Geometry, points: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Whether samples around each point lie outside, ``[L, 2]``, ``[S, 2]`` -> bool ``[L, S]``."""
    boundary = shapely.boundary(polygon)
    radius = np.hypot(*offsets.T).max()
    shapely.prepare([polygon, boundary])
    # Far from the boundary all samples lie on the side of their centre.
    centre_outside = ~shapely.contains_xy(polygon, points)
    outside = np.repeat(centre_outside[:, None], len(offsets), axis=1)
    real = np.flatnonzero(np.isfinite(points).all(-1))
    centres = shapely.points(points[real])
    near = real[shapely.dwithin(boundary, centres, radius)]
    n_parts = len(near) // _POINTS_AT_ONCE + 1
    for part in np.array_split(near, n_parts):
        samples = points[part, None] + offsets
        x = samples[..., 0]
        y = samples[..., 1]
        outside[part] = ~shapely.contains_xy(polygon, x, y)
    return outside


@functools.cache
def _overlap() -> Tensor:
    """Overlap masks for every offset of two discs, ``[G * G, words]``, for any R and region."""
    samples = _unit_disc_samples(64 * _WORDS).astype(np.float32)
    axis = np.linspace(-2, 2, _GRID, dtype=np.float32)
    offsets = samples.T[:, None] - axis[:, None]
    dx2, dy2 = np.square(offsets)  # [G, S] each
    table = torch.stack([packed_bits(row + dy2 < 1) for row in dx2])
    border = [0, -1]
    table[border] = 0
    table[:, border] = 0
    return table.view(-1, _WORDS)


def packed_bits(bits: np.ndarray) -> Tensor:
    """Booleans, 64 packed into one int64: ``[*, 64 * W]`` -> ``[*, W]``."""
    packed = np.packbits(bits, axis=-1, bitorder="little")
    return torch.from_numpy(packed.view(np.int64))
