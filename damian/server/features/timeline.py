"""What is known of the other UAVs, ordered by when it was true."""

import torch
from torch import Tensor

from damian.common.tensors import gather_rows
from damian.server.config import EVENTS, PENDING, ObservationConfig
from damian.server.features.base import FeatureCache, ServerContext, feature
from damian.server.features.others import OTHERS, four, of_nearest, ways_to_nearest
from damian.transforms.timeline import told_slots
from damian.world.messages import Messages
from damian.world.simulation import Simulation


def stop_facts(messages: Messages, context: ServerContext) -> Tensor:
    """Where the latest stops of which messages tell have been [m], and what happened there,
    [*, S, 2 + E]."""
    places = gather_rows(context.points, messages.trail)
    if not messages.events.shape[-1]:
        return places
    return torch.cat([places, messages.events], -1)


def stop_ages(messages: Messages, context: ServerContext) -> Tensor:
    """How long ago they were when the message was generated [steps], [*, S]; -1 for those before
    the reset.

    A stop is a landing, or the choice to hold, at its instant.
    """
    since = messages.time.unsqueeze(-1) - messages.landed
    ages = (since / context.dt).round().long()
    return torch.where(messages.landed < 0, -1, ages)


def known_stops(v: FeatureCache) -> Tensor:
    """Each UAV's known stops by their age, [*, slots, 3 + E]: ``ServerContext.timeline``, or the
    stops that the held messages tell if there is no timeline."""
    context = v.context
    if context.timeline is not None:
        return context.timeline
    facts = stop_facts(v.messages, context)
    as_of_now = v.messages._replace(time=context.now.unsqueeze(-1))
    ages = stop_ages(as_of_now, context)
    facts, told = told_slots(facts, ages, context.observation.timeline)
    return torch.cat([facts, told.unsqueeze(-1)], -1)


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
    known = v(known_stops)
    if known.shape[-1] > 3:  # events stand between place and mark
        known = torch.cat([known[..., :2], known[..., -1:]], -1)
    flies = messages.in_flight.to(known.dtype).unsqueeze(-1)
    destination = torch.cat([messages.target, flies], -1).unsqueeze(-2)
    ways = ways_to_nearest(v, torch.cat([known, destination], -2))
    return four(ways.flatten(-2)).unflatten(-1, ways.shape[-2:])


@feature(
    "global",
    [OTHERS, None, 4],
    low=-1.0,
    name="stops",
    entries=["east", "north", "age", "known"],
    rows="others",
)
def _stops(v: FeatureCache) -> Tensor:
    """The latest stops of the four nearest other UAVs, as their newest messages list them, the
    newest first, [*, N, 4, S, 4]; S is ``observation.stops``.

    Of each: the way to it, east and north, as in ``timeline``, how long ago it was, over 2 S steps,
    and 1. A timeline has the same places ordered by when they were, and those of older messages.
    """
    messages = v.messages
    places = gather_rows(v.context.points, messages.trail)
    since = v.context.now[..., None, None] - messages.landed
    age = since / (2 * messages.trail.shape[-1] * v.context.dt)
    known = (messages.landed >= 0).to(places.dtype)
    return _timed_places(v, places, age, known)


def _timed_places(v: FeatureCache, places: Tensor, time: Tensor, exists: Tensor) -> Tensor:
    """Ways to places of the four nearest other UAVs, each with a time in [-1, 1], and 1; zeros
    where none exists, [*, N, 4, P, 4].

    ``places`` [*, N, P, 2] are in metres; ``time``, and ``exists`` of 0 and 1, [*, N, P].
    """
    ways = ways_to_nearest(v, torch.cat([places, exists.unsqueeze(-1)], -1))
    times = of_nearest(v, (time * exists).clamp(-1, 1)).unsqueeze(-1)
    rows = torch.cat([ways[..., :2], times, ways[..., 2:]], -1)
    return four(rows.flatten(-2)).unflatten(-1, rows.shape[-2:])


def columns_of_events(simulation: Simulation, _: ObservationConfig) -> tuple[str, ...]:
    """What each value of ``events`` is in a scenario."""
    n_sources = len(simulation.sources) * simulation.config.seeks_source
    heard = [f"heard source {i + 1}" for i in range(n_sources)]
    return (*heard, *["served"] * (simulation.widths.requests > 0))


@feature("global", [OTHERS, None, None], name=EVENTS, entries=columns_of_events, rows="others")
def _events(v: FeatureCache) -> Tensor:
    """What happened at the stops of which ``timeline`` tells, [*, N, 4, ``slots``, E].

    In each slot whether the UAV heard each source when it landed there, and, if there are
    requests, whether it served one; zeros if no message that has arrived tells of that step.
    """
    known = v(known_stops)[..., 2:-1]
    return four(of_nearest(v, known.flatten(-2))).unflatten(-1, known.shape[-2:])


@feature(
    "actor",
    [OTHERS, None, 4],
    low=-1.0,
    name="announced",
    entries=["east", "north", "until", "announced"],
    rows="others",
)
def _announced(v: FeatureCache) -> Tensor:
    """Where the commands under way will take the four nearest other UAVs, by their newest messages,
    [*, N, 4, D, 4].

    Of each command, the newest first: the way to its place, east and north, as in ``timeline``,
    how many steps from now it will have been executed, over D, and 1. It may not come true.
    """
    announced = v.messages.announced
    place, by, exists = announced[..., :2], announced[..., 2], announced[..., 3]
    until = (by - v.context.now[..., None, None]) / (v.context.dt * by.shape[-1])
    return _timed_places(v, place, until, exists)


@feature(
    "local",
    [None, 5],
    low=-1.0,
    name=PENDING,
    entries=["east", "north", "age", "executed", "pending"],
    rows="commands",
)
def _pending(v: FeatureCache) -> Tensor:
    """What a UAV knows of its own latest commands, some of which may be lost or dropped,
    [*, N, P, 5].

    Of each, the newest first: the way to its place, east and north, as in ``timeline``, how long
    ago it was chosen, over P steps, whether a message tells that it, or a later one, was executed,
    and 1.
    """
    pending = v.wanted(v.messages.pending)
    place, chosen, facts = pending.split([2, 1, 2], -1)
    frame = v.wanted(v.messages.target).unsqueeze(-2)
    age = (v.context.now[..., None, None, None] - chosen) / (v.context.dt * pending.shape[-2])
    exists = facts[..., 1:]
    known = torch.cat([v.scaled(place - frame), age, facts], -1)
    return (known * exists).clamp(-1, 1)
