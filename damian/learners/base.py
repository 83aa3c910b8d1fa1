"""The interface of a learner: its settings, its actor, and its updates from collected batches."""

import math
from collections.abc import Mapping
from typing import Any, Protocol

import torch
from tensordict import NestedKey, TensorDictBase
from torch import nn
from torchrl.modules import ProbabilisticActor

from damian import keys
from damian.learners.config import LEARNERS, LearnerConfig, LearningSetup  # noqa: F401


class Learner(Protocol):
    """A learner updates its actor from batches as they are collected."""

    actor: ProbabilisticActor
    """The policy that the collector uses; ``LearnerConfig.make_actor`` makes an equal one for evaluations."""

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Update the networks from consecutive steps [B, T]; returns numbers to log, by name.

        The batch has the environment's entries, the extras in ``reads``, and what the actor has written.
        """
        ...

    def components(self) -> dict[str, Any]:
        """What a checkpoint stores, by name, ``actor`` among them: everything that changes in training.

        Each has ``state_dict`` (of tensors, numbers, strings, lists and dicts) and ``load_state_dict``. The
        replay buffer of ``LearnerConfig.make`` is stored without them; what it holds must not be changed in
        place.
        """
        ...


UNREAD: list[NestedKey] = ["collector", keys.LOGITS, keys.LOC, keys.SCALE]
"""Entries that a collector and an actor write, and no learner reads; they are not stored."""
LARGEST_WEIGHT = 1e5
"""Weights of useful networks are thousands of times smaller."""


@torch.no_grad()
def divergence(components: Mapping[str, Any], numbers: Mapping[str, float]) -> str | None:
    """Which number shows that a learner has diverged; None if none does. A logged nan need not."""
    for name, number in numbers.items():
        if math.isinf(number):
            return f"{name} is {number}"
    for name, component in components.items():
        weights = component.parameters() if isinstance(component, nn.Module) else []
        largest = nn.utils.get_total_norm([each for each in weights if each.numel()], math.inf).item()
        if not largest <= LARGEST_WEIGHT:  # true also for nan
            return f"a weight of {name} is {largest:.3g}, not at most {LARGEST_WEIGHT:g}"
    return None
