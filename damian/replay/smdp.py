"""Decisions among stored steps, as semi-Markov transitions (Sutton, Precup and Singh 1999)."""

from typing import NamedTuple, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from damian import keys
from damian.keys import next_key


class Decisions(NamedTuple):
    """K choices of UAVs that were ready, whose consequences are known."""

    begin: Tensor
    """Step at which the UAV chose, [K]."""
    world: Tensor
    """[K]."""
    agent: Tensor
    """[K]."""
    end: Tensor
    """The decision's last step, [K]: after it the UAV chooses again, or the episode has ended."""

    def sample(self, n: int) -> "Decisions":
        """Draw n of them, with replacement."""
        drawn = torch.randint(len(self.begin), (n,), device=self.begin.device)
        return Decisions(*(part[drawn] for part in self))


def find_decisions(
    ready: Tensor, ready_next: Tensor, done: Tensor, terminated: Tensor, n_decisions: int = 1
) -> Decisions:
    """All decisions in T consecutive steps that have ended by the last of these.

    Decisions that a time limit truncates in flight are left out: their outcome is unknown.

    Args:
        ready: could the UAV choose before each step, [T, B, N].
        ready_next: could it after the step, [T, B, N].
        done: did the episode end with the step, [T, B].
        terminated: and not by a time limit, [T, B].
        n_decisions: join so many consecutive decisions, as far as the episode goes (n-step returns).
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
    known = (ready_next | terminated.unsqueeze(-1)).gather(0, end.clamp(max=n_steps - 1))
    begin, world, agent = (ready & known & (end < n_steps)).nonzero().unbind(-1)
    return Decisions(begin, world, agent, end[begin, world, agent])


def transitions(
    steps: TensorDictBase, order: Tensor, decisions: Decisions, gamma: float, observed: list[str]
) -> TensorDict:
    """Decisions as transitions of one agent, [K], as TorchRL's losses for single agents read them.

    The reward is the sum of the rewards from begin to end, discounted by step; ``steps_to_next_obs`` [K, 1]
    is the number of steps by which the next value is to be discounted.

    Args:
        steps: stored steps, [*, B], with ``"agents"`` [*, B, N].
        order: index of each consecutive step in them, [T].
        decisions: steps count from 0 to T - 1.
        gamma: discount of a step.
        observed: entries of an agent that are taken before the decision and after it.
    """
    begin, world, agent, end = decisions
    before, last = (order[begin], world, agent), (order[end], world, agent)
    agents, after = (cast(TensorDictBase, steps[key]) for key in (keys.AGENTS, next_key(keys.AGENTS)))
    chosen = {"action": agents["action"][before], **{key: agents[key][before] for key in observed}}
    step = begin + torch.arange(int((end - begin).max()) + 1, device=begin.device).unsqueeze(-1)  # [H, K]
    index = order[torch.minimum(step, end)], world
    durations = (step <= end).long()
    if next_key(keys.DURATION) in steps:
        durations = durations * steps[next_key(keys.DURATION)].squeeze(-1)[index]  # with ``clock.skip``
    rewards = after["reward"].squeeze(-1)[*index, agent] * (step <= end)
    earned = (gamma ** (durations.cumsum(0) - durations) * rewards).sum(0)
    following = {"reward": earned.unsqueeze(-1), **{key: after[key][last] for key in observed}}
    ends = {key: steps[next_key(key)][last[:2]] for key in (keys.DONE, keys.TERMINATED)}
    n = len(begin)
    return TensorDict(
        {
            keys.AGENTS: TensorDict(chosen, [n]),
            "next": TensorDict({keys.AGENTS: TensorDict(following, [n]), **ends}, [n]),
            "steps_to_next_obs": durations.sum(0).unsqueeze(-1),
        },
        [n],
    )
