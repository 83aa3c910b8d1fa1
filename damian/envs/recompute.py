"""Recomputes stored steps of UAVs with the server node, for ``BackupdateStorage``."""

from collections.abc import Callable, Collection

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
    observers = {"critic", "actor"}.intersection(corrected)
    observed = bool(observers)
    commanded = server.tells_commands and observed
    if commanded:
        observers, own = set(), False
    if own:
        observers.remove("actor")
    kept = {key for name, key in CORRECTED.items() if name not in corrected}
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
        if commanded:
            sent = steps[next_key(keys.COMMANDS)]
            entries[keys.GLOBAL_OBSERVATION] = server.observe_all_commanded(
                messages, sent, elapsed, belief, timeline
            )
            if "actor" in corrected:
                known = steps[next_key(keys.MESSAGE)] if server.observation.own else messages
                beliefs = belief, steps.get(next_key(keys.OWN_BELIEF), None)
                entries[keys.OBSERVATION] = server.observe_own_commanded(
                    messages, server.commanded(known, sent), elapsed, *beliefs, timeline
                )
        if own:
            sent = steps[next_key(keys.MESSAGE)]
            own_belief = steps.get(next_key(keys.OWN_BELIEF), None)
            own_timeline = steps.get(next_key(keys.OWN_STOPS), None)
            entries[keys.OBSERVATION] = server.observe_with_own_messages(
                messages, sent, elapsed, own_belief, timeline, own_timeline
            )
        return {next_key(key): value for key, value in entries.items() if key not in kept}

    return recompute


def timeline_in_hindsight(server: Server, steps: TensorDictBase) -> Tensor:
    """What is known of stops after each stored step, by all that has arrived by now,
    [T, B, N, slots, 3 + E]."""
    messages = steps[next_key(keys.MESSAGE)]
    ages = server.stop_ages(messages)
    facts, told = told_slots(server.stop_facts(messages), ages, server.observation.timeline)
    arrived = steps[next_key(keys.MESSAGE_SENT)]
    if next_key(keys.DELAY) in steps.keys(True):
        arrived = arrived & _arrived(steps)
    told = (told & arrived.unsqueeze(-1)).unsqueeze(-1)
    new = torch.cat([facts, torch.ones_like(facts[..., :1])], -1)

    def advance(known: Tensor, step: int) -> Tensor:
        older = F.pad(known[..., :-1, :], (0, 0, 1, 0))  # a step older
        return torch.where(told[step], new[step], older)

    return _one_after_another(steps, keys.STOPS, advance)


def _arrived(steps: TensorDictBase) -> Tensor:
    """Which messages of stored steps have arrived by the last of these, [T, B, N] bool."""
    delay = steps[next_key(keys.DELAY)].squeeze(-1)
    step = torch.arange(len(delay), device=delay.device).view(-1, 1, 1)
    return arrived_by_now(delay, len(delay) - 1 - step)


def _begins(steps: TensorDictBase, like: Tensor) -> Tensor:
    """Which stored steps begin an episode, to broadcast against values [T, B, ...]."""
    return expand_mask(steps[keys.STEP_COUNT].squeeze(-1) == 0, like)


def _one_after_another(
    steps: TensorDictBase, key: NestedKey, advance: Callable[[Tensor, int], Tensor]
) -> Tensor:
    """The entry after each stored step, as ``advance`` makes it from that before, [T, B, ...].

    Where the episode of the first step began earlier, what had been told then is not known: there
    the entry after it stays.
    """
    before = steps[key]
    begins = _begins(steps, before)
    value = before[0]
    found = []
    for i in range(len(before)):
        value = torch.where(begins[i], before[i], value)
        value = advance(value, i)
        if i == 0:
            value = torch.where(begins[0], value, steps[next_key(key)][0])
        found.append(value)
    return torch.stack(found)


def beliefs_in_hindsight(server: Server, steps: TensorDictBase) -> Tensor:
    """The belief after each stored step, from what has arrived by now, [T, B, K, C]; the first is
    final."""
    assert server.grid is not None
    grid = server.grid
    messages = server.messages(steps[next_key(keys.MESSAGE)])
    level = server.level(messages)
    rows = report_rows(grid, messages, level, _arrived(steps))
    first = report_rows(grid, server.messages(steps[keys.MESSAGE]), level)
    previous = torch.where(_begins(steps, rows), first, rows.roll(1, 0))
    place = places(grid, server.region_of(messages), level)
    likely = likelihood(grid, repeated(grid, rows, previous), place)

    def advance(belief: Tensor, step: int) -> Tensor:
        predicted = predict(grid, belief, place[step])
        return weigh(predicted, likely[step])

    return _one_after_another(steps, keys.BELIEF, advance)
