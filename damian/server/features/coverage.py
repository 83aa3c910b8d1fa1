"""Features of the ground that has been covered: the paper's share, and a map about the UAV."""

import math

import numpy as np
import shapely
import torch
from torch import Tensor

from damian.common.tensors import distances, gather_rows
from damian.server.config import ObservationConfig
from damian.server.features.base import FeatureCache, feature, footprint_radii
from damian.world.coverage import (
    FootprintTables,
    covered_share,
    own_covered_share,
    tables_of_all,
)
from damian.world.simulation import Simulation

RINGS = (0.6, 1.25, 2.5)
"""Distances of the places of ``coverage_map`` from the UAV, in footprint radii."""
SECTORS = 8
"""Number of places on each ring; the first one lies north, the others follow clockwise."""
_OLDEST = 0.5
"""How new ground in the oldest footprint of the window nearly is, in [0, 1]; in the newest one it
is 0."""


def footprint_tables(
    simulation: Simulation, _: ObservationConfig
) -> tuple[FootprintTables, Tensor]:
    """Masks of all footprints, and the landing points, each for every radius, in the unit of the
    first one."""
    airspace = simulation.airspace
    radii = footprint_radii(simulation)
    polygons = [region.polygon for region in airspace.regions]
    lattices = airspace.points.double().cpu().numpy()
    tables = tables_of_all(polygons, lattices, radii)
    points = airspace.points.flatten(0, 1)
    scaled = [points * (radii[0] / radius) for radius in radii]
    return tables, torch.cat(scaled)


def map_places_inside(simulation: Simulation, _: ObservationConfig) -> Tensor:
    """Whether the places of ``coverage_map`` lie in the region, for every radius, [V*R*L, 24] of 0
    and 1."""
    airspace = simulation.airspace
    points = airspace.points.nan_to_num(posinf=0.0).double().cpu().numpy()
    found = []
    for radius in footprint_radii(simulation):
        places = points[:, :, None] + ring_places(radius).double().numpy()
        for region, about in zip(airspace.regions, places, strict=True):
            east, north = np.moveaxis(about, -1, 0)
            found.append(shapely.contains_xy(region.polygon, east, north))
    return torch.from_numpy(np.concatenate(found)).float()


def ring_places(radius: float | Tensor, device: torch.device | None = None) -> Tensor:
    """Offsets of the places of ``coverage_map`` from a UAV [m], [24, 2]; the inner ring first.

    For radii [*, 1, 1], [*, 24, 2].
    """
    number = torch.arange(SECTORS, device=device)
    angle = number * (2 * math.pi / SECTORS)
    ring = torch.stack([angle.sin(), angle.cos()], -1)
    return torch.cat([ring * distance * radius for distance in RINGS], -2)


@feature("global", name="coverage", tables=[footprint_tables])
def _coverage(v: FeatureCache) -> Tensor:
    """Share of the UAV's latest footprints that is new and belongs to no other UAV, [*, N]."""
    footprints, points = v.table(footprint_tables)
    trail = v.tabled(v.trail)
    places = gather_rows(points, trail)
    if v.own_only:
        return own_covered_share(footprints, trail, places).unsqueeze(-1)
    return covered_share(footprints, trail, places)


@feature("global", [len(RINGS) * SECTORS], name="coverage_map", tables=[map_places_inside])
def _coverage_map(v: FeatureCache) -> Tensor:
    """How new the ground at the places about the UAV is, from 0 (just covered, or outside) to 1,
    [*, N, 24].

    It is the distance of a place from the nearest of all UAVs' latest landing points, over the
    diameter of a footprint; older landing points of ``observation.window`` count as further away.
    """
    context = v.context
    trail = v.trail
    standing = v.wanted(trail[..., 0])
    radius = v.radius
    offsets = ring_places(radius, standing.device).unsqueeze(-3)
    places = gather_rows(context.points, standing).unsqueeze(-2) + offsets
    window = trail.shape[-1]
    landed = gather_rows(context.points, trail.transpose(-2, -1))  # [*, n, N, 2]
    # One instant of the window after the other compiles to a loop that is five times as fast.
    about = places.flatten(-3, -2)
    nearest = torch.stack([nearest_distance(each, about) for each in landed.unbind(-3)], -2)
    age = torch.arange(window, device=trail.device).unsqueeze(-1) / window
    new = (nearest / (2 * radius) + _OLDEST * age).amin(-2)
    new = new.view(places.shape[:-1]).clamp(max=1)
    return new * gather_rows(v.table(map_places_inside), v.tabled(standing))


def nearest_distance(places: Tensor, others: Tensor) -> Tensor:
    """Distance of each of the others [*, Q, 2] from the nearest of the places [*, P, 2], [*, Q]."""
    if places.is_cuda or torch.compiler.is_compiling():
        (east, north), (others_east, others_north) = map(_coordinates, (places, others))
        square = (east.unsqueeze(-1) - others_east.unsqueeze(-2)).square()
        square = square + (north.unsqueeze(-1) - others_north.unsqueeze(-2)).square()
        return square.amin(-2).sqrt()
    return distances(places, others).amin(-2)


@torch.library.custom_op("damian::coordinates", mutates_args=())
def _coordinates(places: Tensor) -> Tensor:
    """The coordinates [2, *] of places [*, 2], each in one piece of memory.

    A compiler cannot look into it, so that it does not gather the places anew for each of their
    pairs with others, which kept the loop over pairs from being vectorised.
    """
    return places.movedim(-1, 0).clone(memory_format=torch.contiguous_format)


@_coordinates.register_fake
def _(places):  # compilers need only the shape
    return places.new_empty(places.shape[-1:] + places.shape[:-1])
