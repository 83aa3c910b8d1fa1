"""Features of requests, which UAVs serve by landing near them."""

import torch
from torch import Tensor
from torch.nn import functional as F

from damian.common.tensors import distances
from damian.server.features.base import FeatureCache, feature
from damian.world.messages import Messages
from damian.world.requests import is_open

REQUESTS = 4
"""Number of open requests that ``requests`` describes, the nearest ones."""


def known_requests(messages: Messages) -> tuple[Tensor, Tensor]:
    """The latest known request of each slot, [*, M, 3], and which of them nobody is known to have
    served."""
    appeared = messages.requests[..., 2]
    knows = appeared.argmax(-2)[..., None, :, None]  # the one UAV, [*, 1, M, 1]
    requests = messages.requests.take_along_dim(knows, -3).squeeze(-3)
    return requests, is_open(requests, messages.served)


def assignments(uavs: Tensor, places: Tensor, wanted: Tensor) -> Tensor:
    """The place, of those ``wanted`` [*, K], to which each UAV is assigned, [*, N]; -1 for none.

    UAVs are at [*, N, 2], places at [*, K, 2] m; of those left, the nearest pair is assigned first.
    """
    cost = distances(uavs, places).masked_fill(~wanted.unsqueeze(-2), torch.inf)
    n_uavs, n_places = cost.shape[-2:]
    row = torch.arange(n_uavs, device=uavs.device)
    column = torch.arange(n_places, device=uavs.device)
    goal = torch.full(cost.shape[:-1], -1, device=uavs.device)
    for _ in range(min(n_uavs, n_places)):
        least, pair = cost.flatten(-2).min(-1)
        one = (pair // n_places).unsqueeze(-1)
        place = (pair % n_places).unsqueeze(-1)
        own = (row == one) & least.isfinite().unsqueeze(-1)
        goal = torch.where(own, place, goal)
        taken = (row == one).unsqueeze(-1) | (column == place).unsqueeze(-2)
        cost = cost.masked_fill(taken, torch.inf)
    return goal


@feature(
    "global",
    [REQUESTS, 4],
    low=-1.0,
    name="requests",
    entries=["east", "north", "age", "open"],
    rows="requests",
)
def _requests(v: FeatureCache) -> Tensor:
    """The open requests that are nearest to where the UAV stands or will land, the nearest first,
    [*, N, 4, 4].

    Of each of four: the way to it, east and north, over half the largest vertex distance of the
    region, its age over ``observation.time_scale``, and 1; zeros stand for those that do not exist.
    """
    requests, unserved = known_requests(v.messages)
    place, appeared = requests.split([2, 1], -1)
    own = v.wanted(v.messages.target).unsqueeze(-2)
    ways = v.scaled(place.unsqueeze(-3) - own)  # [*, N, M, 2]
    since = v.context.now[..., None, None] - appeared
    age = (since / v.context.time_scale).clamp(0, 1)
    age = age.unsqueeze(-3).expand(*ways.shape[:-1], 1)
    unserved = unserved.unsqueeze(-2)
    rows = torch.cat([ways.clamp(-1, 1), age, torch.ones_like(age)], -1)
    rows = rows * unserved.unsqueeze(-1)
    distance = ways.square().sum(-1)
    distance = distance.masked_fill(~unserved, torch.inf)
    order = distance.argsort(dim=-1, stable=True)
    nearest = order[..., :REQUESTS].unsqueeze(-1)
    found = rows.take_along_dim(nearest, -2)
    missing = REQUESTS - found.shape[-2]
    return F.pad(found, (0, 0, 0, missing))


@feature("local", name="served")
def _served(v: FeatureCache) -> Tensor:
    """Whether the UAV serves a request with this message, 0 or 1, [*, N]."""
    return v.messages.serves.sum(-1)
