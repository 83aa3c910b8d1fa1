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
from damian.server.features import FeatureCache, feature, of_others
from damian.world.airspace import Airspace
from damian.world.messages import Messages
from damian.world.requests import is_open

RINGS = (0.6, 1.25, 2.5)
"""Distances of the places of ``coverage_map`` from the UAV, in footprint radii."""
SECTORS = 8
"""Number of places on each ring; the first one lies north, the others follow clockwise."""
OTHERS = 4
"""Number of other UAVs that ``others`` describes, the nearest ones."""
REQUESTS = 4
"""Number of open requests that ``requests`` describes, the nearest ones."""
_OLDEST = 0.5
"""How new ground in the oldest footprint of the window nearly is, in [0, 1]; in the newest one it is 0."""


def ring_places(radius: float | Tensor, device: torch.device | None = None) -> Tensor:
    """Offsets of the places of ``coverage_map`` from a UAV [m], [24, 2]; the inner ring first.

    For radii [*, 1, 1], [*, 24, 2].
    """
    angle = torch.arange(SECTORS, device=device) * (2 * math.pi / SECTORS)
    ring = torch.stack([angle.sin(), angle.cos()], -1)
    return torch.cat([ring * distance * radius for distance in RINGS], -2)


def places_inside(airspace: Airspace, radius: float) -> Tensor:
    """Whether the places about each landing point lie in its region, by flat id, [R*L, 24] of 0 and 1."""
    points = airspace.points.nan_to_num(posinf=0.0).double().cpu().numpy()
    places = points[:, :, None] + ring_places(radius).double().numpy()
    inside = [
        shapely.contains_xy(region.polygon, *np.moveaxis(places[i], -1, 0))
        for i, region in enumerate(airspace.regions)
    ]
    return torch.from_numpy(np.stack(inside)).float().flatten(0, 1)


@feature("local", width=2, low=-1.0, name="place")
def _place(v: FeatureCache) -> Tensor:
    """Where the UAV stands or will land, east and north, over half the largest vertex distance, [*, N, 2]."""
    return (v.messages.target / (v.scale.unsqueeze(-1) / 2)).clamp(-1, 1)


@feature("local", width=OTHERS + 1, name="number")
def _number(v: FeatureCache) -> Tensor:
    """Which UAV it is: 1 in one of five columns, in the first one for the first and the sixth, [*, N, 5].

    UAVs that share a network and decide at once share out the ground only if something tells them apart.
    """
    known = v.messages.time
    columns = torch.arange(known.shape[-1], device=known.device) % (OTHERS + 1)
    return F.one_hot(columns, OTHERS + 1).float().expand(*known.shape, OTHERS + 1)


@feature("local", name="kind", width=2)
def _kind(v: FeatureCache) -> Tensor:
    """Largest speed and battery capacity of the UAV, over the largest of all UAVs, [*, N, 2]."""
    assert v.context.kinds is not None
    return v.context.kinds.expand(*v.messages.time.shape, 2)


@feature("local", name="time_left")
def _time_left(v: FeatureCache) -> Tensor:
    """Time left of ``observation.time_scale``, by default that of an episode, as its share, [*, N]."""
    left = 1 - v.context.now / v.context.time_scale
    return left.clamp(0, 1).unsqueeze(-1).expand(v.messages.time.shape)


@feature("global", width=5 * OTHERS, low=-1.0, name="others")
def _others(v: FeatureCache) -> Tensor:
    """The nearest other UAVs, the nearest first, [*, N, 20]; zeros stand for those that do not exist.

    Of each: the way to its place and to its target, east and north, over half the largest vertex distance of
    the region, clamped to [-1, 1], and 1.
    """
    messages = v.messages
    places = torch.stack([messages.position, messages.target], -2)
    ways = _ways_to_nearest(v, F.pad(places, (0, 1), value=1.0))
    return _four(torch.cat([ways[..., 0, :2], ways[..., 1, :]], -1))


@feature("global", width=OTHERS, name="ages")
def _ages(v: FeatureCache) -> Tensor:
    """Ages of what is known of the UAVs that ``others`` describes, over ten seconds, [*, N, 4]."""
    age = v.messages.age(v.context.now) / v.context.observation.age_scale
    return _four(_of_nearest(v, age.unsqueeze(-1)).clamp(max=1))


@feature("timeline", width=None, low=-1.0, name="timeline")
def _timeline(v: FeatureCache) -> Tensor:
    """What is known of the four nearest other UAVs by when it was true, [*, N, 4 (3 ``slots`` + 3)].

    Of each, slot k tells where it landed, or held, k steps ago: the way to that place, east and north, over
    half the largest vertex distance of the region, and 1. It is zeros if no message that has arrived tells of
    that step. Behind the slots stands the same of the destination of a UAV in flight. Ways begin where the
    observer is bound for.
    """
    messages, context, slots = v.messages, v.context, v.context.observation.timeline
    since = ((context.now[..., None, None] - messages.landed) / context.dt).round().long()  # [*, N, S]
    slot = torch.where((messages.landed < 0) | (since > slots), slots, since)  # the last one is left out
    stops = F.pad(gather_rows(context.points, messages.trail), (0, 1), value=1.0)  # [*, N, S, 3]
    table = stops.new_zeros(*slot.shape[:-1], slots + 1, 3)
    table = table.scatter(-2, slot.unsqueeze(-1).expand_as(stops), stops)[..., :slots, :]
    flies = messages.in_flight.to(stops.dtype).unsqueeze(-1)
    table = torch.cat([table, torch.cat([messages.target, flies], -1).unsqueeze(-2)], -2)
    return _four(_ways_to_nearest(v, table).flatten(-2))


def known_requests(messages: Messages) -> tuple[Tensor, Tensor]:
    """The latest known request of each slot, [*, M, 3], and which of them nobody is known to have served."""
    newest = messages.requests[..., 2].argmax(-2)[..., None, :, None]  # who knows it, [*, 1, M, 1]
    requests = messages.requests.gather(-3, newest.expand(*newest.shape[:-1], 3)).squeeze(-3)
    return requests, is_open(requests, messages.served)


@feature("global", name="requests", width=4 * REQUESTS, low=-1.0)
def _requests(v: FeatureCache) -> Tensor:
    """The open requests that are nearest to where the UAV stands or will land, the nearest first, [*, N, 16].

    Of each of four: the way to it, east and north, over half the largest vertex distance of the region, its
    age over ``observation.time_scale``, and 1; zeros stand for those that do not exist.
    """
    requests, unserved = known_requests(v.messages)
    own, half = v.wanted(v.messages.target), (v.context.scale / 2)[..., None, None, None]
    ways = (requests[..., :2].unsqueeze(-3) - own.unsqueeze(-2)) / half  # [*, N, M, 2]
    age = (v.context.now.unsqueeze(-1) - requests[..., 2]) / v.context.time_scale
    age = age.clamp(0, 1)[..., None, :, None].expand(*ways.shape[:-1], 1)
    rows = torch.cat([ways.clamp(-1, 1), age, torch.ones_like(age)], -1) * unserved[..., None, :, None]
    distance = ways.square().sum(-1).masked_fill(~unserved.unsqueeze(-2), torch.inf)
    nearest = distance.argsort(dim=-1, stable=True)[..., :REQUESTS].unsqueeze(-1)
    found = rows.gather(-2, nearest.expand(*nearest.shape[:-1], 4))
    return F.pad(found, (0, 0, 0, REQUESTS - found.shape[-2])).flatten(-2)


@feature("local", name="served")
def _served(v: FeatureCache) -> Tensor:
    """Whether the UAV serves a request with this message, 0 or 1, [*, N]."""
    return v.messages.serves.sum(-1)


def _nearest(v: FeatureCache) -> Tensor:
    """Indices of at most four other UAVs, those with the nearest targets, the nearest first, [*, N, 4]."""
    target, half = v.messages.target, (v.context.scale / 2)[..., None, None, None]
    ways = (target.unsqueeze(-3) - v.wanted(target).unsqueeze(-2)) / half
    distance = of_others(v, ways.square().sum(-1, keepdim=True)).squeeze(-1)
    found = distance.argsort(dim=-1, stable=True)[..., :OTHERS]  # of the others
    itself = torch.arange(target.shape[-2], device=target.device).unsqueeze(-1)
    return found + (found >= (itself.unsqueeze(-1) if v.own_only else itself))


def _of_nearest(v: FeatureCache, table: Tensor) -> Tensor:
    """The rows of a table [*, N, F] for the nearest other UAVs of each, [*, N, 4, F]."""
    nearest = v(_nearest)
    rows = table.unsqueeze(-3).expand(*nearest.shape[:-1], *table.shape[-2:])
    return rows.gather(-2, nearest.unsqueeze(-1).expand(*nearest.shape, table.shape[-1]))


def _ways_to_nearest(v: FeatureCache, places: Tensor) -> Tensor:
    """Ways to places of the nearest other UAVs, and 1; zeros where a place is not known, [*, N, 4, P, 3].

    ``places`` [*, N, P, 3]: east, north, and 1 if it is known, else 0.
    """
    half, own = v.context.scale / 2, v.wanted(v.messages.target).unsqueeze(-2)
    places, known = _of_nearest(v, places.flatten(-2)).unflatten(-1, (-1, 3)).split([2, 1], -1)
    ways = ((places - own.unsqueeze(-2)) / half[..., None, None, None, None]).clamp(-1, 1)
    return torch.cat([ways * known, known], -1)


def _four(described: Tensor) -> Tensor:
    """Descriptions of at most four UAVs [*, N, 4, F], with zeros for those that do not exist, [*, N, 4 F]."""
    return F.pad(described, (0, 0, 0, OTHERS - described.shape[-2])).flatten(-2)


@feature("global", width=len(RINGS) * SECTORS, name="coverage_map")
def _coverage_map(v: FeatureCache) -> Tensor:
    """How new the ground at the places about the UAV is, from 0 (just covered, or outside) to 1, [*, N, 24].

    It is the distance of a place from the nearest of all UAVs' latest landing points, over the diameter of a
    footprint; older landing points of ``observation.window`` count as further away.
    """
    context, trail = v.context, v.trail
    assert context.places_inside is not None
    standing, radius = v.wanted(trail[..., 0]), context.radius
    if isinstance(radius, Tensor):
        radius = radius[..., None, None]
    offsets = ring_places(radius, standing.device).unsqueeze(-3)
    places = gather_rows(context.points, standing).unsqueeze(-2) + offsets
    n_agents, window = trail.shape[-2:]
    landed = gather_rows(context.points, trail.transpose(-2, -1)).flatten(-3, -2)  # [*, n N, 2]
    distance = distances(landed, places.flatten(-3, -2))  # places last, over which minima are fast
    nearest = distance.unflatten(-2, (window, n_agents)).amin(-2)  # of all UAVs, [*, n, N 24]
    age = torch.arange(window, device=trail.device).unsqueeze(-1) / window
    new = (nearest / (2 * radius) + _OLDEST * age).amin(-2).view(places.shape[:-1])
    return new.clamp(max=1) * gather_rows(context.places_inside, v.tabled(standing))
