"""Recomputes stored steps of UAVs with the server node, for ``BackupdateStorage``."""

from collections.abc import Collection

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from damian import keys
from damian.keys import next_key
from damian.replay.backupdate import Recompute
from damian.replay.hindsight import arrived_by_now
from damian.server.belief import likelihood, places, predict, repeated, report_rows, weigh
from damian.server.server import Server

CORRECTED = {"reward": keys.REWARD, "critic": keys.GLOBAL_OBSERVATION, "actor": keys.OBSERVATION}
"""What late messages can correct in stored steps, and where it lies; of the actors' observations not what
``ActionHistory`` appends."""


def server_recompute(
    server: Server, corrected: Collection[str] = ("reward", "critic"), reward_terms: bool = False
) -> Recompute:
    """A ``BackupdateStorage.recompute``: what the server would have output, had it held other messages.

    ``corrected``: names in ``CORRECTED``; the ends of episodes always are.
    """
    own = "actor" in corrected and server.observation.own
    observers = {"critic", "actor"}.intersection(corrected) - ({"actor"} if own else set())
    believes = server.grid is not None and (own or bool(observers) or server.rewards_belief)

    def recompute(steps: TensorDictBase, messages: Tensor) -> dict[NestedKey, Tensor]:
        elapsed = steps[next_key(keys.STEP_COUNT)].squeeze(-1)
        source_over = steps.get(next_key(keys.SOURCE_OVER), None)
        belief = beliefs_in_hindsight(server, steps) if believes else None
        messages = server.with_own_knowledge(messages, steps[next_key(keys.MESSAGE)])
        held = server.messages(messages)
        outputs = server(held, elapsed, source_over, belief=belief, observers=observers)
        entries = outputs.entries(reward_terms)
        if belief is not None:
            entries[keys.BELIEF] = belief
        if own:
            sent, own_belief = steps[next_key(keys.MESSAGE)], steps.get(next_key(keys.OWN_BELIEF), None)
            entries[keys.OBSERVATION] = server.observe_with_own_messages(messages, sent, elapsed, own_belief)
        kept = {CORRECTED[name] for name in CORRECTED if name not in corrected}
        return {next_key(key): value for key, value in entries.items() if key not in kept}

    return recompute


def beliefs_in_hindsight(server: Server, steps: TensorDictBase) -> Tensor:
    """The belief after each stored step, from what has arrived by now, [T, B, K, C]; the first is final."""
    assert server.grid is not None
    grid, messages = server.grid, server.messages(steps[next_key(keys.MESSAGE)])
    delay = steps[next_key(keys.DELAY)].squeeze(-1)
    step = torch.arange(len(delay), device=delay.device).view(-1, 1, 1)
    arrived = arrived_by_now(delay, len(delay) - 1 - step)
    begins = (steps[keys.STEP_COUNT] == 0).unsqueeze(-1)
    before, after = steps[keys.BELIEF], steps[next_key(keys.BELIEF)]
    level, first = server.level(messages), server.messages(steps[keys.MESSAGE])
    rows, first = report_rows(grid, messages, level, arrived), report_rows(grid, first, level)
    previous = torch.where(begins, first, rows.roll(1, 0))
    place = places(grid, server.region_of(messages), level)
    likely = likelihood(grid, repeated(grid, rows, previous), place)
    belief, corrected = before[0], []
    for i in range(len(delay)):  # each belief follows from the one before
        belief = torch.where(begins[i], before[i], belief)
        belief = weigh(predict(grid, belief, place[i]), likely[i])
        if i == 0:  # where its episode began earlier, what had been reported then is not known
            belief = torch.where(begins[0], belief, after[0])
        corrected.append(belief)
    return torch.stack(corrected)
