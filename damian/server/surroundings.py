"""Features of what surrounds a UAV: its place, the other UAVs, and the ground that has been covered about it.

With them a policy can learn to cover any region instead of one by heart, and their width does not depend on
the number of UAVs. They go beyond the paper's Table 2.
"""

import math

import numpy as np
import shapely
import torch
from torch import Tensor
from torch.nn import functional as F

from damian.common.tensors import distances, gather_rows
from damian.server.features import FEATURES, FeatureCache, feature, of_others
from damian.world.airspace import Airspace

RINGS = (0.6, 1.25, 2.5)
"""Distances of the places of ``coverage_map`` from the UAV, in footprint radii."""
SECTORS = 8
"""Number of places on each ring; the first one lies north, the others follow clockwise."""
OTHERS = 4
"""Number of other UAVs that ``others`` describes, the nearest ones."""
_OLDEST = 0.5
"""How new ground in the oldest footprint of the window nearly is, in [0, 1]; in the newest one it is 0."""


def ring_places(radius: float, device: torch.device | None = None) -> Tensor:
    """Offsets of the places of ``coverage_map`` from a UAV [m], [24, 2]; the inner ring first."""
    angle = torch.arange(SECTORS, device=device) * (2 * math.pi / SECTORS)
    ring = torch.stack([angle.sin(), angle.cos()], -1)
    return torch.cat([ring * distance * radius for distance in RINGS])


def places_inside(airspace: Airspace, radius: float) -> Tensor:
    """Whether the places about each landing point lie in its region, by flat id, [R*L, 24] of 0 and 1."""
    points = airspace.points.nan_to_num(posinf=0.0).double().cpu().numpy()
    places = points[:, :, None] + ring_places(radius).double().numpy()
    inside = [
        shapely.contains_xy(region.polygon, *np.moveaxis(places[i], -1, 0))
        for i, region in enumerate(airspace.regions)
    ]
    return torch.from_numpy(np.stack(inside)).float().flatten(0, 1)


@FEATURES.register("place")
@feature("local", width=2, low=-1.0)
def _place(v: FeatureCache) -> Tensor:
    """Where the UAV stands or will land, east and north, over half the largest vertex distance, [*, N, 2]."""
    return (v.messages.target / (v.scale.unsqueeze(-1) / 2)).clamp(-1, 1)


@FEATURES.register("number")
@feature("local", width=OTHERS + 1)
def _number(v: FeatureCache) -> Tensor:
    """Which UAV it is: 1 in one of five columns, in the first one for the first and the sixth, [*, N, 5].

    UAVs that share a network and decide at once share out the ground only if something tells them apart.
    """
    known = v.messages.time
    columns = torch.arange(known.shape[-1], device=known.device) % (OTHERS + 1)
    return F.one_hot(columns, OTHERS + 1).float().expand(*known.shape, OTHERS + 1)


@FEATURES.register("time_left")
@feature("local")
def _time_left(v: FeatureCache) -> Tensor:
    """Time left of ``observation.time_scale``, by default that of an episode, as its share, [*, N]."""
    left = 1 - v.context.now / v.context.time_scale
    return left.clamp(0, 1).unsqueeze(-1).expand(v.messages.time.shape)


@FEATURES.register("others")
@feature("global", width=5 * OTHERS, low=-1.0)
def _others(v: FeatureCache) -> Tensor:
    """The nearest other UAVs, the nearest first, [*, N, 20]; zeros stand for those that do not exist.

    Of each: the way to its place and to its target, east and north, over half the largest vertex distance of
    the region, and 1.
    """
    messages, own = v.messages, v.wanted(v.messages.target).unsqueeze(-2)
    ways = torch.cat([messages.position.unsqueeze(-3) - own, messages.target.unsqueeze(-3) - own], -1)
    ways = F.pad(ways / (v.context.scale / 2)[..., None, None, None], (0, 1), value=1.0)  # [*, N, N, 5]
    ways = of_others(v, ways)
    nearest = ways[..., 2:4].square().sum(-1).argsort(dim=-1, stable=True)[..., :OTHERS]
    ways = ways.gather(-2, nearest.unsqueeze(-1).expand(*nearest.shape, 5))
    return F.pad(ways.clamp(-1, 1), (0, 0, 0, OTHERS - nearest.shape[-1])).flatten(-2)


@FEATURES.register("coverage_map")
@feature("global", width=len(RINGS) * SECTORS)
def _coverage_map(v: FeatureCache) -> Tensor:
    """How new the ground at the places about the UAV is, from 0 (just covered, or outside) to 1, [*, N, 24].

    It is the distance of a place from the nearest of all UAVs' latest landing points, over the diameter of a
    footprint; older landing points of ``observation.window`` count as further away.
    """
    context, trail = v.context, v.messages.trail
    assert context.places_inside is not None
    standing = v.wanted(trail[..., 0])
    offsets = ring_places(context.radius, standing.device)
    places = gather_rows(context.points, standing).unsqueeze(-2) + offsets
    landed = gather_rows(context.points, trail)  # [*, N, n, 2]
    distance = distances(places.flatten(-3, -2), landed.flatten(-3, -2)) / (2 * context.radius)
    age = torch.arange(trail.shape[-1], device=trail.device) / trail.shape[-1]
    new = distance.view(*places.shape[:-1], *trail.shape[-2:]) + _OLDEST * age
    return new.flatten(-2).amin(-1).clamp(max=1) * gather_rows(context.places_inside, standing)
