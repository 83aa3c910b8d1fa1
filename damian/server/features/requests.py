"""Features of requests, which UAVs serve by landing near them."""

import torch
from torch import Tensor
from torch.nn import functional as F

from damian.server.features.base import FeatureCache, feature
from damian.world.messages import Messages
from damian.world.requests import is_open

REQUESTS = 4
"""Number of open requests that ``requests`` describes, the nearest ones."""


def known_requests(messages: Messages) -> tuple[Tensor, Tensor]:
    """The latest known request of each slot, [*, M, 3], and which of them nobody is known to have
    served."""
    newest = messages.requests[..., 2].argmax(-2)[..., None, :, None]  # who knows it, [*, 1, M, 1]
    requests = messages.requests.gather(-3, newest.expand(*newest.shape[:-1], 3)).squeeze(-3)
    return requests, is_open(requests, messages.served)


@feature(
    "global",
    [REQUESTS, 4],
    low=-1.0,
    name="requests",
    entries=["east", "north", "age", "open"],
    rows=True,
)
def _requests(v: FeatureCache) -> Tensor:
    """The open requests that are nearest to where the UAV stands or will land, the nearest first,
    [*, N, 4, 4].

    Of each of four: the way to it, east and north, over half the largest vertex distance of the
    region, its age over ``observation.time_scale``, and 1; zeros stand for those that do not exist.
    """
    requests, unserved = known_requests(v.messages)
    own = v.wanted(v.messages.target)
    half = (v.context.scale / 2)[..., None, None, None]
    ways = (requests[..., :2].unsqueeze(-3) - own.unsqueeze(-2)) / half  # [*, N, M, 2]
    age = (v.context.now.unsqueeze(-1) - requests[..., 2]) / v.context.time_scale
    age = age.clamp(0, 1)[..., None, :, None].expand(*ways.shape[:-1], 1)
    rows = (
        torch.cat([ways.clamp(-1, 1), age, torch.ones_like(age)], -1) * unserved[..., None, :, None]
    )
    distance = ways.square().sum(-1).masked_fill(~unserved.unsqueeze(-2), torch.inf)
    nearest = distance.argsort(dim=-1, stable=True)[..., :REQUESTS].unsqueeze(-1)
    found = rows.gather(-2, nearest.expand(*nearest.shape[:-1], 4))
    return F.pad(found, (0, 0, 0, REQUESTS - found.shape[-2]))


@feature("local", name="served")
def _served(v: FeatureCache) -> Tensor:
    """Whether the UAV serves a request with this message, 0 or 1, [*, N]."""
    return v.messages.serves.sum(-1)
