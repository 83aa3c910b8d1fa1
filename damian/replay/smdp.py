"""Finds decisions in stored steps and joins each into a semi-Markov transition
(Sutton et al. 1999)."""

from typing import NamedTuple, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from damian import keys
from damian.common.tensors import next_true
from damian.keys import next_key


class Decisions(NamedTuple):
    """K decisions: actions of ready UAVs, each with the steps until the UAV chooses again."""

    begin: Tensor
    """First step of the decision, at which the UAV chose its action, [K]."""
    world: Tensor
    """Index of the UAV's world, [K]."""
    agent: Tensor
    """Index of the UAV in its world, [K]."""
    end: Tensor
    """Last step of the decision, [K]: after it the UAV chooses again, or the episode has ended."""

    def sample(self, n: int) -> "Decisions":
        """Draw n decisions at random, with replacement."""
        drawn = torch.randint(len(self.begin), (n,), device=self.begin.device)
        return Decisions(*(part[drawn] for part in self))


def find_decisions(
    ready: Tensor, ready_next: Tensor, done: Tensor, terminated: Tensor
) -> Decisions:
    """All decisions in T consecutive steps that have ended by the last of these steps.

    Decisions that a time limit truncates in flight are left out, because their outcome is unknown.
    ``ready`` and ``ready_next`` [T, B, N] tell whether a UAV could choose before and after each
    step, ``done`` and ``terminated`` [T, B] how the episode ended.
    """
    n_steps = len(ready)
    end = next_true(ready_next | done.unsqueeze(-1))  # n_steps if it has not ended yet
    outcome_known = (ready_next | terminated.unsqueeze(-1)).gather(0, end.clamp(max=n_steps - 1))
    begin, world, agent = (ready & outcome_known & (end < n_steps)).nonzero().unbind(-1)
    return Decisions(begin, world, agent, end[begin, world, agent])


def transitions(
    steps: TensorDictBase,
    order: Tensor,
    decisions: Decisions,
    gamma: float,
    observed: list[str],
    team: float = 0.0,
) -> TensorDict:
    """Turn K decisions into transitions of single agents, [K], in the form that TorchRL's losses
    read.

    The reward of a transition is the sum of the rewards from ``begin`` to ``end``, discounted by
    step; ``steps_to_next_obs`` [K, 1] is the number of steps by which the next value is to be
    discounted. ``order`` is the index in ``steps`` [*, B] of each of T consecutive steps, from
    which the decisions count; ``observed`` names the agents' entries that a transition has before
    and after the decision. ``team`` is the share of the mean reward of all agents in each one's.
    """
    begin, world, agent, end = decisions
    before = (order[begin], world, agent)
    last = (order[end], world, agent)
    agents, after = (
        cast(TensorDictBase, steps[key]) for key in (keys.AGENTS, next_key(keys.AGENTS))
    )
    at_begin = {
        "action": agents["action"][before],
        **{key: agents[key][before] for key in observed},
    }
    step = begin + torch.arange(int((end - begin).max()) + 1, device=begin.device).unsqueeze(
        -1
    )  # [H, K]
    index = order[torch.minimum(step, end)], world
    earned = after["reward"].squeeze(-1)
    rewards = earned[*index, agent]
    if team:
        rewards = torch.lerp(rewards, earned[index].mean(-1), team)
    reward = (gamma ** (step - begin) * rewards * (step <= end)).sum(0)
    at_end = {"reward": reward.unsqueeze(-1), **{key: after[key][last] for key in observed}}
    ends = {key: steps[next_key(key)][last[:2]] for key in (keys.DONE, keys.TERMINATED)}
    n = len(begin)
    return TensorDict(
        {
            keys.AGENTS: TensorDict(at_begin, [n]),
            "next": TensorDict({keys.AGENTS: TensorDict(at_end, [n]), **ends}, [n]),
            "steps_to_next_obs": (end - begin + 1).unsqueeze(-1),
        },
        [n],
    )
