"""What is known of the other UAVs, ordered by when it was true."""

import torch
from torch import Tensor

from damian.common.tensors import gather_rows
from damian.server.features.base import FeatureCache, ServerContext, feature
from damian.server.features.others import OTHERS, four, ways_to_nearest
from damian.transforms.timeline import told_slots
from damian.world.messages import Messages


def stop_places(messages: Messages, context: ServerContext) -> Tensor:
    """Where the latest stops of which messages tell have been [m], [*, S, 2]."""
    return gather_rows(context.points, messages.trail)


def stop_ages(messages: Messages, context: ServerContext) -> Tensor:
    """How long ago they were when the message was generated [steps], [*, S]; -1 for those before
    the reset.

    A stop is a landing, or the choice to hold, at its instant.
    """
    since = messages.time.unsqueeze(-1) - messages.landed
    ages = (since / context.dt).round().long()
    return torch.where(messages.landed < 0, -1, ages)


def told_timeline(messages: Messages, context: ServerContext) -> Tensor:
    """What these messages alone tell, [*, slots, 3], as ``ServerContext.timeline``."""
    facts = stop_places(messages, context)
    as_of_now = messages._replace(time=context.now.unsqueeze(-1))
    ages = stop_ages(as_of_now, context)
    places, told = told_slots(facts, ages, context.observation.timeline)
    return torch.cat([places, told.unsqueeze(-1)], -1)


@feature(
    "timeline",
    [OTHERS, None, 3],
    low=-1.0,
    name="timeline",
    entries=["east", "north", "known"],
    rows="others",
)
def _timeline(v: FeatureCache) -> Tensor:
    """What is known of the four nearest other UAVs by when it was true,
    [*, N, 4, ``slots`` + 1, 3].

    Of each, slot k tells where it landed, or held, k steps ago: the way to that place, east and
    north, over half the largest vertex distance of the region, and 1. It is zeros if no message
    that has arrived tells of that step. Behind the slots stands the same of the destination of a
    UAV in flight. Ways begin where the observer is bound for.
    """
    messages = v.messages
    context = v.context
    known = context.timeline
    if known is None:
        known = told_timeline(messages, context)
    flies = messages.in_flight.to(known.dtype).unsqueeze(-1)
    destination = torch.cat([messages.target, flies], -1).unsqueeze(-2)
    ways = ways_to_nearest(v, torch.cat([known, destination], -2))
    return four(ways.flatten(-2)).unflatten(-1, ways.shape[-2:])
