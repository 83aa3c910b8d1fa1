"""Operative regions as padded tensors, with tests for inside a polygon and searches for landing points."""

from dataclasses import dataclass, fields, replace

import numpy as np
import shapely
import torch
from torch import Tensor

from damian.common.errors import InputError
from damian.world.regions.polygon import landing_lattice, largest_vertex_distance
from damian.world.regions.region import Region


@dataclass(frozen=True)
class Airspace:
    """``R`` operative regions with at most ``L`` landing points and ``E`` polygon edges each.

    A landing point's *flat id* is ``region * L + point``; padded points lie infinitely far away.

    Attributes:
        points: landing points, [R, L, 2] metres.
        n_points: number of real landing points, [R].
        edges: polygon edges ``x1, y1, x2, y2`` (holes included), [R, E, 4] metres.
        scale: largest distance between two vertices, [R] metres; features divide distances by it.
        regions: the R regions, with their polygons and names.
    """

    points: Tensor
    n_points: Tensor
    edges: Tensor
    scale: Tensor
    regions: tuple[Region, ...]

    @property
    def max_points(self) -> int:
        """Largest number of landing points in a region (L)."""
        return self.points.shape[1]

    def to(self, device: torch.device) -> "Airspace":
        """Copy of the airspace on another device."""
        moved = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "regions"}
        return replace(self, **{name: tensor.to(device) for name, tensor in moved.items()})


def build_airspace(
    regions: list[Region], step_m: float, degrees: float, n_points: int | None, n_agents: int
) -> Airspace:
    """Lay the lattice of landing points over each region.

    Args:
        regions: operative regions.
        step_m: distance between neighbouring points of a row [m].
        degrees: slant of the lattice [deg].
        n_points: number of landing points to keep in each region, nearest its centroid; all if None.
        n_agents: number of UAVs.

    Raises:
        InputError: a region has fewer landing points than there are UAVs.
    """
    lattices = [landing_lattice(r.polygon, step_m, degrees, n_points) for r in regions]
    for region, lattice in zip(regions, lattices, strict=True):
        if len(lattice) < n_agents:
            raise InputError(
                f"agents: {n_agents} UAVs need as many landing points, but {region.name} has "
                f"{len(lattice)}; lower agents or region.lattice_step ({step_m:g} m)"
            )
    edges = [_edges(region.polygon) for region in regions]
    return Airspace(
        points=_padded(lattices, torch.inf),
        n_points=torch.tensor([len(lattice) for lattice in lattices]),
        # A padded edge has zero length, so the inside test never counts it.
        edges=_padded(edges, 0.0),
        scale=torch.tensor([largest_vertex_distance(r.polygon) for r in regions], dtype=torch.float32),
        regions=tuple(regions),
    )


def inside(edges: Tensor, target: Tensor) -> Tensor:
    """Whether each target lies inside its polygon (even-odd rule); concave polygons and holes are allowed.

    Args:
        edges: polygon edges ``x1, y1, x2, y2``, [*, E, 4] metres.
        target: [*, 2] metres.

    Returns:
        Bool, [*].
    """
    x1, y1, x2, y2 = edges.unbind(-1)
    x, y = target[..., :1], target[..., 1:]
    straddles = (y1 > y) != (y2 > y)
    # A horizontal edge divides by zero here, but it never straddles, so the result is not used.
    crossing = x1 + (y - y1) * (x2 - x1) / (y2 - y1)
    return ((straddles & (x < crossing)).sum(-1) % 2).bool()


def nearest_points(points: Tensor, target: Tensor, n: int) -> Tensor:
    """The ``n`` landing points nearest each target, nearest first; of equal distances, the lowest id first.

    Args:
        points: [*, L, 2] metres; padded points lie infinitely far away.
        target: [*, 2] metres.

    Returns:
        Point ids, [*, n].
    """
    east, north = (points[..., i].double() - target[..., i : i + 1].double() for i in (0, 1))
    # This term is far below any real difference of squared distances, so it only breaks ties.
    order = 1e-9 * torch.arange(points.shape[-2], device=points.device, dtype=torch.float64)
    return (east.square() + north.square() + order).topk(n, dim=-1, largest=False).indices


def _edges(polygon: shapely.Geometry) -> np.ndarray:
    """Every edge of every ring, [E, 4] metres."""
    rings = shapely.get_rings(shapely.get_parts(polygon))
    corners = [shapely.get_coordinates(ring) for ring in rings]
    return np.concatenate([np.hstack([ring[:-1], ring[1:]]) for ring in corners])


def _padded(arrays: list[np.ndarray], value: float) -> Tensor:
    """Stack arrays of different lengths as float32, [R, longest, ...]."""
    longest = max(len(a) for a in arrays)
    stacked = np.full((len(arrays), longest, *arrays[0].shape[1:]), value)
    for row, array in zip(stacked, arrays, strict=True):
        row[: len(array)] = array
    return torch.as_tensor(stacked, dtype=torch.float32)
