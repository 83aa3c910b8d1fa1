"""Decisions among stored steps, and what each of them has earned until its UAV could choose again."""

from typing import NamedTuple, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor


class Decisions(NamedTuple):
    """K choices of UAVs that were ready, whose consequences are known."""

    begin: Tensor
    """Step at which the UAV chose, [K]."""
    world: Tensor
    """[K]."""
    agent: Tensor
    """[K]."""
    end: Tensor
    """Last step that belongs to it, [K]: after it the UAV chooses anew, or the episode has ended."""

    def draw(self, n: int) -> "Decisions":
        """So many of them, with replacement."""
        drawn = torch.randint(len(self.begin), (n,), device=self.begin.device)
        return Decisions(*(part[drawn] for part in self))


def find_decisions(
    ready: Tensor, ready_next: Tensor, done: Tensor, terminated: Tensor, n_decisions: int = 1
) -> Decisions:
    """All decisions in consecutive steps that had come to an end by the last of them.

    Those that a time limit cuts in flight are none: of what would have come of them, nothing is learnt.

    Args:
        ready: could the UAV choose before each step, [T, B, N].
        ready_next: could it after the step, [T, B, N].
        done: did the episode end with it, [T, B].
        terminated: and for good, not by a time limit, [T, B].
        n_decisions: take so many in a row as one, as far as the episode goes (n-step returns).
    """
    n_steps = len(ready)
    steps = torch.arange(n_steps, device=ready.device).view(-1, 1, 1)
    ended = done.unsqueeze(-1).expand_as(ready)
    closes = torch.where(ready_next | ended, steps, n_steps)  # n_steps: not yet
    first = closes.flip(0).cummin(0).values.flip(0)
    first = torch.cat([first, torch.full_like(first[:1], n_steps)])
    end = first[:-1]
    for _ in range(n_decisions - 1):
        over = ended.gather(0, end.clamp(max=n_steps - 1))
        end = torch.where(over, end, first.gather(0, (end + 1).clamp(max=n_steps)))
    told = (ready_next | terminated.unsqueeze(-1)).gather(0, end.clamp(max=n_steps - 1))
    begin, world, agent = (ready & told & (end < n_steps)).nonzero().unbind(-1)
    return Decisions(begin, world, agent, end[begin, world, agent])


def transitions(
    steps: TensorDictBase, order: Tensor, decisions: Decisions, gamma: float, seen: list[str]
) -> TensorDict:
    """Decisions as transitions of one agent, [K]: what TorchRL's losses for single agents read.

    The reward is the sum of the rewards meanwhile, discounted by step, and ``steps_to_next_obs`` [K, 1] tells
    by how many steps the next value is to be discounted (semi-Markov; Sutton, Precup and Singh 1999).

    Args:
        steps: stored steps, [*, B], with ``"agents"`` [*, B, N].
        order: where each consecutive step lies in them, [T].
        decisions: with steps that count from 0 to T - 1.
        gamma: discount of a step.
        seen: entries of an agent that are taken before the decision and after it.
    """
    begin, world, agent, end = decisions
    before, last = (order[begin], world, agent), (order[end], world, agent)
    agents, after = (cast(TensorDictBase, steps[key]) for key in ("agents", ("next", "agents")))
    chosen = {"action": agents["action"][before], **{key: agents[key][before] for key in seen}}
    step = begin + torch.arange(int((end - begin).max()) + 1, device=begin.device).unsqueeze(-1)  # [H, K]
    meanwhile = order[torch.minimum(step, end)], world
    lasts = (step <= end).long()
    if ("next", "duration") in steps:
        lasts = lasts * steps["next", "duration"].squeeze(-1)[meanwhile]  # longer with ``clock.skip``
    rewards = after["reward"].squeeze(-1)[*meanwhile, agent] * (step <= end)
    earned = (gamma ** (lasts.cumsum(0) - lasts) * rewards).sum(0)
    following = {"reward": earned.unsqueeze(-1), **{key: after[key][last] for key in seen}}
    ends = {key: steps["next", key][last[:2]] for key in ("done", "terminated")}
    n = len(begin)
    return TensorDict(
        {
            "agents": TensorDict(chosen, [n]),
            "next": TensorDict({"agents": TensorDict(following, [n]), **ends}, [n]),
            "steps_to_next_obs": lasts.sum(0).unsqueeze(-1),
        },
        [n],
    )
