"""What is known of the other UAVs, ordered by when it was true."""

import torch
from torch import Tensor
from torch.nn import functional as F

from damian.common.tensors import gather_rows
from damian.server.features.base import FeatureCache, feature
from damian.server.features.others import OTHERS, four, ways_to_nearest


@feature(
    "timeline", [OTHERS, None, 3], low=-1.0, name="timeline", entries=["east", "north", "known"], rows=True
)
def _timeline(v: FeatureCache) -> Tensor:
    """What is known of the four nearest other UAVs by when it was true, [*, N, 4, ``slots`` + 1, 3].

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
    ways = ways_to_nearest(v, table)
    return four(ways.flatten(-2)).unflatten(-1, ways.shape[-2:])
