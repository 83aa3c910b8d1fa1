"""Coverage: the share of a UAV's footprint that is new, lies in the region and belongs to no other
UAV.

A footprint is always sampled at the same ``64 * words`` points, so that a part of it is a bit mask.
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

from damian.common.tensors import gather_rows

_GRID = 321
"""Number of offsets from -2R to 2R along each axis; it is odd so that offset 0 is exact."""
_CHUNK_WORDS, _CHUNK_WORDS_LARGE = 2**18, 2**24
"""Words and table rows computed at once: 2 MiB on a CPU; 128 MiB on a GPU and in compiled
graphs."""
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


def build_tables(
    polygons: Sequence[shapely.Polygon | shapely.MultiPolygon],
    points: np.ndarray,
    radius: float,
    words: int = 16,
) -> FootprintTables:
    """Tabulate the masks of all landing points [R, L, 2] in polygons, for a ``radius`` of
    footprints [m].

    With 16 words, over random polygons and up to 5 other discs, the error of one footprint's area
    is 0.2 % (rms) of pi R^2, and below 0.9 % in 3000 random placements; the worst placement that a
    search has found gives 1.1 %. Points of NaN are padding, where nothing counts as covered.
    """
    offsets = radius * _unit_disc_samples(64 * words)
    outside = [_outside(*pair, offsets) for pair in zip(polygons, points, strict=True)]
    masks = torch.cat([_overlap(words), *map(_packed, outside)])
    return FootprintTables(masks, (_GRID - 1) / (4 * radius))


def tables_of_all(
    polygons: Sequence[shapely.Polygon | shapely.MultiPolygon],
    points: np.ndarray,
    radii: Sequence[float],
) -> FootprintTables:
    """The tables of several radii: the landing points of each follow as if they were further ones.

    Their positions are to be given in the unit of the first radius: times this one, over their own.
    """
    first, *others = [build_tables(polygons, points, radius) for radius in radii]
    return first._replace(
        masks=torch.cat([first.masks, *(each.masks[_GRID**2 :] for each in others)])
    )


def covered_share(tables: FootprintTables, point_ids: Tensor, positions: Tensor) -> Tensor:
    """Coverage c_a in [0, 1], ``[*, N]``: mean share of each UAV's last n footprints that counts.

    The part of the footprint at ``positions[..., i, k, :]`` (index 0 newest) counts that lies
    inside the polygon, in the footprint of no other UAV at the same index k, and in no older
    footprint of UAV i itself. Shares are fractions of pi R^2 (paper, Table 2). ``point_ids``
    ``[*, N, n]`` are the landing points of the ``positions`` ``[*, N, n, 2]`` [m].
    """
    lead, (n_uavs, n_last) = point_ids.shape[:-2], point_ids.shape[-2:]
    cells = (positions * tables.cells_per_metre).reshape(-1, n_uavs, n_last, 2)
    # Windows that slide over the UAVs: i, i + 1, i + 2, ... (modulo N), without index tensors.
    fleets = torch.cat([cells, cells[:, :-1]], 1).unfold(1, n_uavs, 1)
    return _share_of_first(tables, point_ids.reshape(-1, n_uavs, n_last), fleets).reshape(
        *lead, n_uavs
    )


class KnownCoverage(NamedTuple):
    """The coverage of a step, from which that of the next one is computed."""

    trail: Tensor
    """Flat ids of the UAVs' latest landing points, ``[*, N, n]`` int64."""
    share: Tensor
    """Their coverage, ``[*, N]``; negative where it is not known."""


def updated_share(
    tables: FootprintTables, point_ids: Tensor, points: Tensor, known: KnownCoverage
) -> Tensor:
    """As ``covered_share``, from all ``points`` [m], but computed only for worlds that have
    changed."""
    changed = (point_ids != known.trail).flatten(-2).any(-1) | (known.share[..., 0] < 0)
    n_uavs, n_last = point_ids.shape[-2:]
    ids = point_ids.reshape(-1, n_uavs, n_last)
    share = known.share.reshape(-1, n_uavs)
    return _update_share(*tables, ids, points, share, changed.reshape(-1)).view(known.share.shape)


@torch.library.custom_op("damian::update_share", mutates_args=())
def _update_share(
    masks: Tensor,
    cells_per_metre: float,
    ids: Tensor,
    points: Tensor,
    share: Tensor,
    changed: Tensor,
) -> Tensor:
    """The shares ``[b, N]``, computed again for the worlds of ``changed [b]``."""
    updated = share.clone()
    worlds = changed.nonzero().squeeze(-1)
    if len(worlds):
        ids = ids.index_select(0, worlds)
        tables = FootprintTables(masks, cells_per_metre)
        updated.index_copy_(0, worlds, covered_share(tables, ids, gather_rows(points, ids)))
    return updated


@_update_share.register_fake
def _(masks, cells_per_metre, ids, points, share, changed):  # compilers need only the shape
    return torch.empty_like(share)


def own_covered_share(tables: FootprintTables, point_ids: Tensor, positions: Tensor) -> Tensor:
    """The diagonal of ``covered_share`` of what each UAV knows, ``[*, N, N, ...]``
    (receiver, sender)."""
    lead, (n_uavs, n_last) = point_ids.shape[:-3], point_ids.shape[-2:]
    uav = torch.arange(n_uavs, device=point_ids.device)
    # The receiver i itself, then i + 1, i + 2, ... (modulo N).
    known = (uav.unsqueeze(-1) * n_uavs + (uav.unsqueeze(-1) + uav) % n_uavs).flatten()
    own = point_ids.reshape(-1, n_uavs**2, n_last).index_select(1, uav * (n_uavs + 1))
    cells = (
        (positions * tables.cells_per_metre)
        .reshape(-1, n_uavs**2, n_last, 2)
        .index_select(1, known)
    )
    fleets = cells.view(-1, n_uavs, n_uavs, n_last, 2).movedim(2, -1)
    return _share_of_first(tables, own, fleets).reshape(*lead, n_uavs)


def _share_of_first(tables: FootprintTables, point_ids: Tensor, fleets: Tensor) -> Tensor:
    """Coverage of the first UAV of each fleet, ``[b, N]``, from positions in cells,
    ``[b, N, n, 2, N]``."""
    n_uavs, n_last = point_ids.shape[1:]
    words_per_world = n_uavs * n_last * (n_uavs + n_last - 1 + tables.masks.shape[-1])
    large = point_ids.device.type != "cpu" or torch.compiler.is_compiling()
    at_once = max(1, (_CHUNK_WORDS_LARGE if large else _CHUNK_WORDS) // words_per_world)
    shares = []
    for ids, fleet in zip(point_ids.split(at_once), fleets.split(at_once), strict=True):
        rows = torch.cat([(ids + _GRID**2).unsqueeze(0), _overlap_rows(fleet).movedim(-1, 0)])
        counts = _bit_count(_or_rows(tables.masks, rows.flatten(1)).view(*ids.shape[:-1], -1))
        # Summed as floats (exact: small integers), which compiles to a much faster loop than int64.
        shares.append(1 - counts.sum(-1, dtype=fleet.dtype) / (64 * counts.shape[-1]))
    return torch.cat(shares)


def _overlap_rows(fleet: Tensor) -> Tensor:
    """Table rows of the discs that may overlap a footprint of the first UAV,
    ``[b, N, n, N + n - 2]``."""
    # First the other UAVs at the same index, then the UAV itself at later ones; a window that
    # slides over the indices leaves out all other pairs, without index tensors.
    cells = fleet[..., 0]
    n_last = fleet.shape[-3]
    past = F.pad(cells, (0, 0, 0, n_last - 1), value=math.inf).unfold(-2, n_last, 1)
    other = torch.cat([fleet[..., 1:], past[..., 1:]], -1)
    # Adding half a cell before truncation rounds to the nearest one.
    cell = (other - (cells - (_GRID / 2)).unsqueeze(-1)).clamp(0, _GRID - 1).long()
    return cell[..., 0, :] * _GRID + cell[..., 1, :]


def _or_rows(table: Tensor, rows: Tensor) -> Tensor:
    """Bitwise OR of M rows of a table [R, words] for each of K sets of them: ``[M, K]`` ->
    ``[K, words]``."""
    first, *others = rows.unbind(0)
    combined = table.index_select(0, first)
    for row in others:
        combined |= table.index_select(0, row)
    return combined


def _bit_count(words: Tensor) -> Tensor:
    """Number of 1 bits of each int64 (H. S. Warren, Hacker's Delight, 2nd ed., 5-1)."""
    # The shift repeats the sign bit, hence a mask after each.
    twos = words - (words >> 1).bitwise_and_(0x5555555555555555)
    fours = (twos >> 2).bitwise_and_(0x3333333333333333).add_(twos & 0x3333333333333333)
    eights = (fours >> 4).add_(fours).bitwise_and_(0x0F0F0F0F0F0F0F0F)
    return eights.mul_(0x0101010101010101) >> 56


def _unit_disc_samples(count: int) -> np.ndarray:
    """Well-spread points of equal weight in the unit disc, ``[count, 2]`` (H. Vogel, 1979)."""
    k = np.arange(count)
    r = np.sqrt((k + 0.5) / count)
    angle = k * np.pi * (3 - math.sqrt(5))
    return np.stack([r * np.cos(angle), r * np.sin(angle)], -1)


def _outside(polygon: shapely.Geometry, points: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Whether samples around each point lie outside, ``[L, 2]``, ``[S, 2]`` -> bool ``[L, S]``."""
    boundary = shapely.boundary(polygon)
    radius = np.hypot(*offsets.T).max()
    shapely.prepare([polygon, boundary])
    real = np.flatnonzero(np.isfinite(points).all(-1))
    # Far from the boundary all samples lie on the side of their centre.
    outside = np.repeat(~shapely.contains_xy(polygon, points)[:, None], len(offsets), axis=1)
    near = real[shapely.dwithin(boundary, shapely.points(points[real]), radius)]
    for part in np.array_split(near, len(near) // _POINTS_AT_ONCE + 1):
        samples = points[part, None] + offsets
        outside[part] = ~shapely.contains_xy(polygon, samples[..., 0], samples[..., 1])
    return outside


@functools.lru_cache(maxsize=2)
def _overlap(words: int) -> Tensor:
    """Overlap masks for every offset of two discs, ``[G * G, words]``, for any R and region."""
    samples = _unit_disc_samples(64 * words).astype(np.float32)
    axis = np.linspace(-2, 2, _GRID, dtype=np.float32)
    dx2, dy2 = np.square(samples.T[:, None] - axis[:, None])  # [G, S] each
    table = torch.stack([_packed(row + dy2 < 1) for row in dx2])
    table[[0, -1]] = table[:, [0, -1]] = 0
    return table.view(-1, words)


def _packed(bits: np.ndarray) -> Tensor:
    """Booleans, 64 packed into one int64: ``[*, 64 * W]`` -> ``[*, W]``."""
    return torch.from_numpy(np.packbits(bits, axis=-1, bitorder="little").view(np.int64))
