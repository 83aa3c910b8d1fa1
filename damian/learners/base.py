"""The interface of a learner: its settings, its actor, and its updates from collected batches."""

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import nn
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor

from damian import keys
from damian.learners.config import LEARNERS, LearnerConfig, LearningSetup  # noqa: F401


class Learner(Protocol):
    """A learner updates its actor from batches as they are collected."""

    actor: ProbabilisticActor
    """The policy that the collector uses; ``LearnerConfig.make_actor`` makes an equal one for
    evaluations."""

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Update the networks from consecutive steps [B, T]; returns numbers to log, by name.

        The batch has the environment's entries, the extras in ``reads``, and what the actor has
        written.
        """
        ...

    def components(self) -> dict[str, Any]:
        """What a checkpoint stores, by name, ``actor`` among them: everything that changes in
        training.

        Each has ``state_dict`` (of tensors, numbers, strings, lists and dicts) and
        ``load_state_dict``. The replay buffer of ``LearnerConfig.make`` is stored without them;
        what it holds must not be changed in place.
        """
        ...


UNREAD: list[NestedKey] = ["collector", keys.LOGITS, keys.LOC, keys.SCALE]
"""Entries that a collector and an actor write, and no learner reads; they are not stored."""
LARGEST_WEIGHT = 1e5
"""Weights of useful networks are thousands of times smaller."""


@dataclass
class Progress:
    """How far a training has come."""

    frames: int = 0
    """Environment steps, over all worlds."""
    updates: int = 0
    """Batches that the learner has learnt from."""

    def state_dict(self) -> dict[str, Any]:
        return dict(vars(self))

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        vars(self).update(state)


@torch.no_grad()
def divergence(components: Mapping[str, Any], numbers: Mapping[str, float]) -> str | None:
    """Which number shows that a learner has diverged; None if none does. A logged nan need not."""
    for name, number in numbers.items():
        if math.isinf(number):
            return f"{name} is {number}"
    for name, component in components.items():
        weights = component.parameters() if isinstance(component, nn.Module) else []
        largest = nn.utils.get_total_norm(
            [each for each in weights if each.numel()], math.inf
        ).item()
        if not largest <= LARGEST_WEIGHT:  # true also for nan
            return f"a weight of {name} is {largest:.3g}, not at most {LARGEST_WEIGHT:g}"
    return None


@torch.no_grad()
def undelayed_talk(actor: ProbabilisticActor, env: EnvBase) -> bool:
    """Whether what an actor computes for one UAV changes with the row of another one.

    That is, the parameters of the actions' distribution, or the next hidden state. The actor is
    tried in evaluation mode with random weights, because a last layer of zeros hides what it reads,
    on random entries of the environment.
    """
    device = torch.device(env.device or "cpu")
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(0)
        tried = copy.deepcopy(actor).eval()
        for weight in tried.parameters():
            weight.normal_(0, weight.shape[-1:].numel() ** -0.5)
        run = getattr(tried, "get_dist_params", tried)
        entries, others = _random_entries(env, 8).split(4)

        def outputs(changed: int | None) -> TensorDictBase:
            """What is computed of all UAVs, [4, N], when the row of one of them has changed."""
            read = entries.clone()
            if changed is not None:
                read[keys.AGENTS][:, changed] = others[keys.AGENTS][:, changed]
            torch.manual_seed(0)
            return run(read)[keys.AGENTS]

        before = outputs(None)
        for uav in range(before.shape[1]):
            same = cast(TensorDictBase, outputs(uav) == before)
            same[:, uav] = True
            if not same.all():
                return True
    return False


def _random_entries(env: EnvBase, worlds: int) -> TensorDictBase:
    """Random outputs of an environment, [worlds]; all actions are legal, and no episode begins."""
    entries = env.observation_spec_unbatched.rand(torch.Size([worlds]))
    for key, flag in ((keys.ACTION_MASK, True), (keys.IS_INIT, False)):
        if key in entries.keys(True):
            entries[key] = torch.full_like(entries[key], flag)
    return entries
