"""The interface of a learner: its settings, its actor, and its updates from collected batches."""

import math
from collections.abc import Mapping
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.modules import ProbabilisticActor

from damian.settings.learners import LEARNERS, READABLE, LearnerConfig, LearningSetup  # noqa: F401


class Learner(Protocol):
    """A learner updates its actor from batches as they are collected."""

    actor: ProbabilisticActor
    """The policy that the collector uses; ``LearnerConfig.make_actor`` makes an equal one for evaluations."""

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Update the networks.

        Args:
            batch: consecutive steps [B, T] of the environment, with the entries of ``damian.keys`` that the
                environment outputs, the extras that the learner's settings name in ``reads``, and what the
                actor has written.

        Returns:
            Numbers to log, by name.
        """
        ...

    def components(self) -> dict[str, Any]:
        """What a checkpoint stores, by name: networks, optimisers, and all else that changes in training.

        One of them is ``actor``. Each has ``state_dict`` and ``load_state_dict``; its state consists of
        tensors, numbers, strings, lists and dicts. A resumed run equals one that was never stopped only if
        everything that changes is among the components. The replay buffer of ``LearnerConfig.make`` is stored
        without them; what it holds must not be changed in place.
        """
        ...


LARGEST_WEIGHT = 1e5
"""Weights of useful networks are thousands of times smaller."""


@torch.no_grad()
def divergence(components: Mapping[str, Any], numbers: Mapping[str, float]) -> str | None:
    """Say which number shows that a learner has diverged; None if it has not.

    A logged nan may only mean that nothing is known yet, as before SAC's warm-up; that of a loss has made the
    weights nan as well.

    Args:
        components: of the learner, by name.
        numbers: that the learner has logged, by name.
    """
    for name, number in numbers.items():
        if math.isinf(number):
            return f"{name} is {number}"
    for name, component in components.items():
        weights = component.parameters() if isinstance(component, nn.Module) else []
        largest = nn.utils.get_total_norm([each for each in weights if each.numel()], math.inf).item()
        if not largest <= LARGEST_WEIGHT:  # true also for nan
            return f"a weight of {name} is {largest:.3g}, not at most {LARGEST_WEIGHT:g}"
    return None
