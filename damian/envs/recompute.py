"""Recomputes stored steps of UAVs with the server node, for ``BackupdateStorage``."""

from collections.abc import Collection

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.nn import functional as F

from damian import keys
from damian.common.tensors import expand_mask
from damian.keys import next_key
from damian.replay.backupdate import Recompute
from damian.replay.hindsight import arrived_by_now
from damian.server.belief import likelihood, places, predict, repeated, report_rows, weigh
from damian.server.server import Server
from damian.transforms.timeline import told_slots

CORRECTED = {"reward": keys.REWARD, "critic": keys.GLOBAL_OBSERVATION, "actor": keys.OBSERVATION}
"""What late messages can correct in stored steps, and where it lies; of the actors' observations
not what ``ActionHistory`` appends."""


def server_recompute(
    server: Server, corrected: Collection[str] = ("reward", "critic"), reward_terms: bool = False
) -> Recompute:
    """A ``BackupdateStorage.recompute``: what the server would have output, had it held other
    messages.

    ``corrected``: names in ``CORRECTED``; the ends of episodes always are.
    """
    own = "actor" in corrected and server.observation.own
    observers = {"critic", "actor"}.intersection(corrected) - ({"actor"} if own else set())
    kept = {CORRECTED[name] for name in CORRECTED if name not in corrected}
    observed = own or bool(observers)
    believes = server.grid is not None and (observed or server.rewards_belief)
    timed = server.observation.timeline > 0 and observed

    def recompute(steps: TensorDictBase, messages: Tensor) -> dict[NestedKey, Tensor]:
        elapsed = steps[next_key(keys.STEP_COUNT)].squeeze(-1)
        source_over = steps.get(next_key(keys.SOURCE_OVER), None)
        belief = beliefs_in_hindsight(server, steps) if believes else None
        timeline = timeline_in_hindsight(server, steps) if timed else None
        messages = server.with_own_knowledge(messages, steps[next_key(keys.MESSAGE)])
        held = server.messages(messages)
        outputs = server(
            held, elapsed, source_over, belief=belief, timeline=timeline, observers=observers
        )
        entries = outputs.entries(reward_terms)
        if belief is not None:
            entries[keys.BELIEF] = belief
        if timeline is not None:
            entries[keys.STOPS] = timeline
        if own:
            read = (keys.MESSAGE, keys.OWN_BELIEF, keys.OWN_STOPS)
            sent, own_belief, own_timeline = (steps.get(next_key(key), None) for key in read)
            entries[keys.OBSERVATION] = server.observe_with_own_messages(
                messages, sent, elapsed, own_belief, timeline, own_timeline
            )
        return {next_key(key): value for key, value in entries.items() if key not in kept}

    return recompute


def timeline_in_hindsight(server: Server, steps: TensorDictBase) -> Tensor:
    """What is known of stops after each stored step, by all that has arrived by now,
    [T, B, N, slots, 3]."""
    messages = steps[next_key(keys.MESSAGE)]
    n_steps = len(steps)
    places, told = told_slots(
        server.stop_places(messages), server.stop_ages(messages), server.observation.timeline
    )
    step = torch.arange(n_steps, device=messages.device).view(-1, 1, 1)
    arrived = steps[next_key(keys.MESSAGE_SENT)]
    if next_key(keys.DELAY) in steps.keys(True):
        delay = steps[next_key(keys.DELAY)].squeeze(-1)
        arrived = arrived & arrived_by_now(delay, n_steps - 1 - step)
    told = (told & arrived.unsqueeze(-1)).unsqueeze(-1)
    new = torch.cat([places, torch.ones_like(places[..., :1])], -1)
    begins = expand_mask(steps[keys.STEP_COUNT].squeeze(-1) == 0, new)
    known = steps[keys.STOPS][0]
    found = []
    for i in range(n_steps):  # each one follows from the one before
        known = torch.where(begins[i], steps[keys.STOPS][i], known)
        older = F.pad(known[..., :-1, :], (0, 0, 1, 0))  # a step older
        known = torch.where(told[i], new[i], older)
        if i == 0:  # where its episode began earlier, what had been told then is not known
            known = torch.where(begins[0], known, steps[next_key(keys.STOPS)][0])
        found.append(known)
    return torch.stack(found)


def beliefs_in_hindsight(server: Server, steps: TensorDictBase) -> Tensor:
    """The belief after each stored step, from what has arrived by now, [T, B, K, C]; the first is
    final."""
    assert server.grid is not None
    grid = server.grid
    messages = server.messages(steps[next_key(keys.MESSAGE)])
    delay = steps[next_key(keys.DELAY)].squeeze(-1)
    step = torch.arange(len(delay), device=delay.device).view(-1, 1, 1)
    arrived = arrived_by_now(delay, len(delay) - 1 - step)
    begins = (steps[keys.STEP_COUNT] == 0).unsqueeze(-1)
    before = steps[keys.BELIEF]
    after = steps[next_key(keys.BELIEF)]
    level = server.level(messages)
    first = server.messages(steps[keys.MESSAGE])
    rows = report_rows(grid, messages, level, arrived)
    first = report_rows(grid, first, level)
    previous = torch.where(begins, first, rows.roll(1, 0))
    place = places(grid, server.region_of(messages), level)
    likely = likelihood(grid, repeated(grid, rows, previous), place)
    belief = before[0]
    corrected = []
    for i in range(len(delay)):  # each belief follows from the one before
        belief = torch.where(begins[i], before[i], belief)
        belief = weigh(predict(grid, belief, place[i]), likely[i])
        if i == 0:  # where its episode began earlier, what had been reported then is not known
            belief = torch.where(begins[0], belief, after[0])
        corrected.append(belief)
    return torch.stack(corrected)
