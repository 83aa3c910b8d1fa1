"""The interface of a learner: its settings, its actor, and its updates from collected batches."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import torch
from tensordict import NestedKey, TensorDictBase
from torch import nn
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor

from damian import keys
from damian.common import checks
from damian.common.registry import Registry
from damian.learners.networks import ModelConfig, make_actor


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


class LearningSetup(NamedTuple):
    """Properties of a run that a learner needs beside its own settings."""

    model: ModelConfig
    """Networks of actor and critic."""
    worlds: int
    """Number of parallel environments, B."""
    shortest_period: int
    """Smallest number of steps per world between two updates."""
    longest_period: int
    """Largest number of steps per world between two updates."""
    longest_delay: int = 0
    """Longest delay of a message, or with back-updating of a reward, if that is longer [steps]."""
    backupdate: bool = False
    """Whether the replay buffer corrects stored steps as late messages arrive (paper, section 3.4)."""
    settle: bool = False
    """Whether to learn from a step only when neither its messages nor its reward can be in transit."""
    recompute_actor: bool = False
    """Whether late messages also replace the actor's observations (the original authors' variant)."""
    critic_key: NestedKey = keys.GLOBAL_OBSERVATION
    """Key of the critic's observation."""
    compile: bool = False
    """Whether to compile the loss, so that updates are faster once it is compiled."""
    frames: int = 300_000
    """Environment steps of the run, over all worlds."""
    action_delay: int | None = 0
    """Delay of every action [steps]; None if it differs between actions."""

    @property
    def settle_steps(self) -> int:
        """Number of steps by which learning from a step is postponed."""
        return self.longest_delay if self.settle else 0

    @property
    def least_buffer(self) -> int:
        """Environment steps that back-updating needs in the buffer: a period and twice the longest delay."""
        return (self.longest_period + 2 * self.longest_delay) * self.worlds


READABLE = ("message", "state", "reward_terms", "privileged", "hindsight")
"""What a learner may name in ``LearnerConfig.reads``."""


@dataclass
class LearnerConfig:
    """Settings of a learner, which make it; those that all learners share.

    A learner of your own has a dataclass derived from this class, with fields for its own settings, that
    implements ``make``. Whatever changes in the learner must be among its ``components``, or a resumed run
    loses it. The settings ``learner=package.module:Name learner.lr=1e-3`` choose it.
    """

    name: str = ""
    """Name of the learner, or the path of its settings' class; the group ``learner`` sets it."""
    lr: float = 3e-4
    """Learning rate of Adam."""
    gamma: float = 0.95
    """Discount factor per step."""
    steps: int = 32
    """Steps per world between two updates, unless ``clock.system`` sets the period."""

    reads: ClassVar[tuple[str, ...]] = ()
    """Optional outputs of the environment that the learner needs in its batches: ``message``, ``state``,
    ``reward_terms`` or ``privileged`` (``damian.make_env``); and ``hindsight``: with back-updating, stored
    steps then also hold the newest message that has arrived since (``keys.HINDSIGHT``)."""

    def __post_init__(self) -> None:
        checks.above("learner.lr", self.lr, 0.0)
        checks.in_range("learner.lr", self.lr, 0.0, 1.0)  # Adam moves a weight by up to this much at once
        checks.in_range("learner.gamma", self.gamma, 0.0, 1.0)
        checks.in_range("learner.steps", self.steps, 1, checks.STEPS)
        checks.names(f"{type(self).__name__}.reads", self.reads, READABLE)

    def check(self, setup: LearningSetup) -> None:
        """Check that this learner can learn in such a run.

        Raises:
            InputError: a setting does not fit; the message names its key.
        """

    def buffer_size(self, setup: LearningSetup) -> int | None:
        """Environment steps, over all worlds, that the replay buffer must hold; None if none is needed."""
        return None

    def make(self, env: EnvBase, setup: LearningSetup, buffer: ReplayBuffer | None) -> Learner:
        """Build the learner for an environment.

        Args:
            env: environment of the training, with batch size [B].
            setup: properties of the run.
            buffer: replay buffer of ``buffer_size`` steps, on a ``TimeStorage``, or with back-updating on a
                ``BackupdateStorage``, which corrects what is stored; None if ``buffer_size`` is None.
        """
        raise NotImplementedError

    def make_actor(self, env: EnvBase, model: ModelConfig) -> ProbabilisticActor:
        """Build an actor as the learner has it, for evaluations, which load its weights."""
        return make_actor(env, model)


def _not_a_learner(found: Any) -> str | None:
    good = isinstance(found, type) and issubclass(found, LearnerConfig)
    if good and "__dataclass_fields__" not in vars(found):  # its own settings would not be found
        return "is no dataclass: write @dataclass above the class"
    return None if good else "is no dataclass derived from damian.LearnerConfig with a method make"


LEARNERS = Registry[type[LearnerConfig]]("learner", _not_a_learner)
"""Settings classes of learners, by name; your own as ``package.module:Name``."""

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
