"""Operative regions as padded tensors, with a test for inside a polygon and a search for landing points."""

from dataclasses import dataclass, fields, replace

import numpy as np
import shapely
import torch
from torch import Tensor

from damian.common.errors import InputError
from damian.common.tensors import tree_map
from damian.world.nearest import LandingGrid, build_grid
from damian.world.regions.polygon import landing_lattice, largest_vertex_distance
from damian.world.regions.region import Region


@dataclass(frozen=True)
class Airspace:
    """``R`` operative regions with at most ``L`` landing points and ``E`` polygon edges each.

    A landing point's *flat id* is ``region * L + point``; padded points lie infinitely far away.

    Attributes:
        points: landing points, [R, L, 2] metres east and north of the local origin of their region.
        exact_points: the same in double precision, by which the nearest ones are found.
        grid: the same sorted into cells, to search for the nearest ones.
        n_points: number of real landing points, [R].
        edges: polygon edges ``x1, y1, x2, y2`` (holes included), [R, E, 4] metres, double precision.
        scale: largest distance between two vertices, [R] metres; features divide distances by it.
        offset: place of the local origin in the coordinates of the settings, [R, 2] metres.
        regions: the R regions, with their polygons and names.
    """

    points: Tensor
    exact_points: Tensor
    grid: LandingGrid
    n_points: Tensor
    edges: Tensor
    scale: Tensor
    offset: Tensor
    regions: tuple[Region, ...]

    @property
    def max_points(self) -> int:
        """Largest number of landing points in a region (L)."""
        return self.points.shape[1]

    def to(self, device: torch.device) -> "Airspace":
        """Copy of the airspace on another device."""
        moved = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("regions", "grid")}
        grid = tree_map(lambda t: t.to(device), self.grid)
        return replace(self, grid=grid, **{name: tensor.to(device) for name, tensor in moved.items()})


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
            remedy = f"lower agents or region.lattice_step ({step_m:g} m)"
            if n_points is not None:
                remedy = f"lower agents, or raise region.n_landing_points ({n_points})"
            raise InputError(
                f"agents: {n_agents} UAVs need as many landing points, but {region.name} has "
                f"{len(lattice)}; {remedy}"
            )
    edges = [_edges(region.polygon) for region in regions]
    points = _padded(lattices, torch.inf)
    return Airspace(
        points=points.float(),
        exact_points=points,
        grid=build_grid(lattices, [r.polygon.area for r in regions], 2 * n_agents - 1),
        n_points=torch.tensor([len(lattice) for lattice in lattices]),
        # A padded edge has zero length, so the inside test never counts it.
        edges=_padded(edges, 0.0),
        scale=torch.tensor([largest_vertex_distance(r.polygon) for r in regions], dtype=torch.float32),
        offset=torch.tensor([r.offset for r in regions], dtype=torch.float32),
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


def _edges(polygon: shapely.Geometry) -> np.ndarray:
    """Every edge of every ring, [E, 4] metres."""
    rings = shapely.get_rings(shapely.get_parts(polygon))
    corners = [shapely.get_coordinates(ring) for ring in rings]
    return np.concatenate([np.hstack([ring[:-1], ring[1:]]) for ring in corners])


def _padded(arrays: list[np.ndarray], value: float) -> Tensor:
    """Stack arrays of different lengths, [R, longest, ...]."""
    longest = max(len(a) for a in arrays)
    stacked = np.full((len(arrays), longest, *arrays[0].shape[1:]), value)
    for row, array in zip(stacked, arrays, strict=True):
        row[: len(array)] = array
    return torch.as_tensor(stacked)
