"""Features of the other UAVs, whose places and targets are those of the latest known messages."""

import torch
from torch import Tensor
from torch.nn import functional as F

from damian.common.tensors import distances
from damian.server.features.base import FeatureCache, feature

OTHERS = 4
"""Number of other UAVs that ``others`` describes, the nearest ones."""
WAYS = ("east", "north", "target east", "target north", "exists")
"""What ``others`` tells of each."""


def pairwise_distances(v: FeatureCache) -> Tensor:
    """Distances from the wanted UAVs to all, over the largest vertex distance of the region,
    [*, N, N]."""
    position = v.messages.position
    return distances(v.wanted(position), position) / v.scale.unsqueeze(-1)


def of_others(v: FeatureCache, pairs: Tensor) -> Tensor:
    """Values [*, N, N, F] of pairs of UAVs without those of a UAV with itself, [*, N, N-1, F].

    With ``own_only``, [*, N, 1, N, F] and [*, N, 1, N-1, F].
    """
    n = pairs.shape[-2]
    flat = pairs.flatten(-4 if v.own_only else -3, -2)
    # In rows of N + 1, all but the first of the diagonal are in the last column.
    different = flat[..., 1:, :].unflatten(-2, (n - 1, n + 1))[..., :-1, :]
    return different.reshape(*pairs.shape[:-2], n - 1, pairs.shape[-1])


@feature("global", [None], name="agent_distances")
def _agent_distances(v: FeatureCache) -> Tensor:
    """Distances to the other UAVs in their order, over the largest vertex distance,
    [*, N, N - 1]."""
    return of_others(v, v(pairwise_distances).unsqueeze(-1)).squeeze(-1).clamp(max=1)


@feature("global", name="mean_distance")
def _mean_distance(v: FeatureCache) -> Tensor:
    """Mean distance to the other UAVs, over the largest vertex distance, [*, N]."""
    return (v(pairwise_distances).sum(-1) / max(v.messages.time.shape[-1] - 1, 1)).clamp(max=1)


@feature("global", name="mean_distance_not_spotting")
def _mean_distance_not_spotting(v: FeatureCache) -> Tensor:
    """Mean distance to the other UAVs that do not spot; 0 for a spotting UAV, or if there are no
    others."""
    silent = (~v.messages.spotted).to(v.scale.dtype)
    others = silent.sum(-1, keepdim=True) - 1
    total = (v(pairwise_distances) * silent.unsqueeze(-2)).sum(-1) * v.wanted(silent)
    return (total / others.clamp(min=1)).clamp(max=1)


@feature("global", [OTHERS, 5], low=-1.0, name="others", entries=WAYS, rows=True)
def _others(v: FeatureCache) -> Tensor:
    """The nearest other UAVs, the nearest first, [*, N, 4, 5]; zeros stand for those that do not
    exist.

    Of each: the way to its place and to its target, east and north, over half the largest vertex
    distance of the region, clamped to [-1, 1], and 1.
    """
    messages = v.messages
    places = torch.stack([messages.position, messages.target], -2)
    ways = ways_to_nearest(v, F.pad(places, (0, 1), value=1.0))
    return four(torch.cat([ways[..., 0, :2], ways[..., 1, :]], -1))


@feature("global", [OTHERS], name="ages")
def _ages(v: FeatureCache) -> Tensor:
    """Ages of what is known of the UAVs that ``others`` describes, over ten seconds, [*, N, 4]."""
    age = v.messages.age(v.context.now) / v.context.observation.age_scale
    return four(_of_nearest(v, age.unsqueeze(-1)).clamp(max=1)).squeeze(-1)


def _nearest(v: FeatureCache) -> Tensor:
    """Indices of at most four other UAVs, those with the nearest targets, the nearest first,
    [*, N, 4]."""
    target = v.messages.target
    half = (v.context.scale / 2)[..., None, None, None]
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


def ways_to_nearest(v: FeatureCache, places: Tensor) -> Tensor:
    """Ways to places of the nearest other UAVs, and 1; zeros where a place is not known,
    [*, N, 4, P, 3].

    ``places`` [*, N, P, 3]: east, north, and 1 if it is known, else 0.
    """
    half = v.context.scale / 2
    own = v.wanted(v.messages.target).unsqueeze(-2)
    places, known = _of_nearest(v, places.flatten(-2)).unflatten(-1, (-1, 3)).split([2, 1], -1)
    ways = ((places - own.unsqueeze(-2)) / half[..., None, None, None, None]).clamp(-1, 1)
    return torch.cat([ways * known, known], -1)


def four(described: Tensor) -> Tensor:
    """Descriptions of at most four UAVs [*, N, 4, F], with zeros for those that do not exist."""
    return F.pad(described, (0, 0, 0, OTHERS - described.shape[-2]))
