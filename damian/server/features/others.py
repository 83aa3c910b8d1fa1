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
    *lead, n, width = pairs.shape
    flat = pairs.flatten(-4 if v.own_only else -3, -2)
    # In rows of N + 1, all but the first of the diagonal are in the last column.
    rows = flat[..., 1:, :].unflatten(-2, (n - 1, n + 1))
    different = rows[..., :-1, :]
    return different.reshape(*lead, n - 1, width)


@feature("global", [None], name="agent_distances")
def _agent_distances(v: FeatureCache) -> Tensor:
    """Distances to the other UAVs in their order, over the largest vertex distance,
    [*, N, N - 1]."""
    distance = of_others(v, v(pairwise_distances).unsqueeze(-1))
    return distance.squeeze(-1).clamp(max=1)


@feature("global", name="mean_distance")
def _mean_distance(v: FeatureCache) -> Tensor:
    """Mean distance to the other UAVs, over the largest vertex distance, [*, N]."""
    n_others = v.messages.time.shape[-1] - 1
    total = v(pairwise_distances).sum(-1)
    return (total / max(n_others, 1)).clamp(max=1)


@feature("global", name="mean_distance_not_spotting")
def _mean_distance_not_spotting(v: FeatureCache) -> Tensor:
    """Mean distance to the other UAVs that do not spot; 0 for a spotting UAV, or if there are no
    others."""
    silent = (~v.messages.spotted).to(v.scale.dtype)
    others = silent.sum(-1, keepdim=True) - 1
    distance = v(pairwise_distances) * silent.unsqueeze(-2)
    total = distance.sum(-1) * v.wanted(silent)
    return (total / others.clamp(min=1)).clamp(max=1)


@feature("global", [OTHERS, 5], low=-1.0, name="others", entries=WAYS, rows="others")
def _others(v: FeatureCache) -> Tensor:
    """The nearest other UAVs, the nearest first, [*, N, 4, 5]; zeros stand for those that do not
    exist.

    Of each: the way to its place and to its target, east and north, over half the largest vertex
    distance of the region, clamped to [-1, 1], and 1.
    """
    messages = v.messages
    places = torch.stack([messages.position, messages.target], -2)
    exists = F.pad(places, (0, 1), value=1.0)
    place, target = ways_to_nearest(v, exists).unbind(-2)
    return four(torch.cat([place[..., :2], target], -1))


@feature("global", [OTHERS], name="ages")
def _ages(v: FeatureCache) -> Tensor:
    """Ages of what is known of the UAVs that ``others`` describes, over ten seconds, [*, N, 4]."""
    known = of_nearest(v, known_ages(v).unsqueeze(-1))
    return four(known.clamp(max=1)).squeeze(-1)


def known_ages(v: FeatureCache) -> Tensor:
    """Ages of the messages over ``observation.age_scale``, [*, N]."""
    age = v.messages.age(v.context.now)
    return age / v.context.observation.age_scale


def _nearest(v: FeatureCache) -> Tensor:
    """Indices of at most four other UAVs, those with the nearest targets, the nearest first,
    [*, N, 4]."""
    target = v.messages.target
    own = v.wanted(target).unsqueeze(-2)
    ways = v.scaled(target.unsqueeze(-3) - own)
    length = ways.square().sum(-1, keepdim=True)
    distance = of_others(v, length).squeeze(-1)
    order = distance.argsort(dim=-1, stable=True)
    found = order[..., :OTHERS]  # of the others
    itself = torch.arange(target.shape[-2], device=target.device).unsqueeze(-1)
    if v.own_only:
        itself = itself.unsqueeze(-1)
    return found + (found >= itself)


def of_nearest(v: FeatureCache, table: Tensor) -> Tensor:
    """The rows of a table [*, N, F] for the nearest other UAVs of each, [*, N, 4, F]."""
    nearest = v(_nearest).unsqueeze(-1)
    return table.unsqueeze(-3).take_along_dim(nearest, -2)


def ways_to_nearest(v: FeatureCache, places: Tensor) -> Tensor:
    """Ways to places of the nearest other UAVs, and 1; zeros where a place is not known,
    [*, N, 4, P, 3].

    ``places`` [*, N, P, 3]: east, north, and 1 if it is known, else 0.
    """
    own = v.wanted(v.messages.target)[..., None, None, :]
    nearest = of_nearest(v, places.flatten(-2))
    place, known = nearest.unflatten(-1, (-1, 3)).split([2, 1], -1)
    ways = v.scaled(place - own).clamp(-1, 1)
    return torch.cat([ways * known, known], -1)


def four(described: Tensor) -> Tensor:
    """Descriptions of at most four UAVs [*, N, 4, F], with zeros for those that do not exist."""
    missing = OTHERS - described.shape[-2]
    return F.pad(described, (0, 0, 0, missing))
