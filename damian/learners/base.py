"""The interface of a learner: its settings, its actor, and its updates from collected batches."""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from tensordict import NestedKey, TensorDictBase
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor

from damian import keys
from damian.common import checks
from damian.learners.networks import ModelConfig


class Learner(Protocol):
    """A learner updates its actor from batches as they are collected."""

    actor: ProbabilisticActor
    """The policy that the collector and the evaluations use."""

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Update from a batch [B, T] of consecutive steps; returns the numbers to log, by name."""
        ...

    def components(self) -> dict[str, Any]:
        """Networks and optimisers that a checkpoint stores, by name; one of them is ``actor``."""
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
    """Longest delay of a message [steps]."""
    backupdate: bool = False
    """Whether the replay buffer corrects stored steps as late messages arrive (paper, section 3.4)."""
    settle: bool = False
    """Whether to learn from a step only when none of its messages can be in transit any more."""
    recompute_actor: bool = False
    """Whether late messages also replace the actor's observations (the original authors' variant)."""
    critic_key: NestedKey = keys.GLOBAL_OBSERVATION
    """Key of the critic's observation."""

    @property
    def settle_steps(self) -> int:
        """Number of steps by which learning from a step is postponed."""
        return self.longest_delay if self.settle else 0


@dataclass
class LearnerConfig:
    """Settings that all learners share."""

    name: str = ""
    """Name of the learner; the group ``learner`` sets it."""
    lr: float = 3e-4
    """Learning rate of Adam."""
    gamma: float = 0.95
    """Discount factor per step."""
    steps: int = 32
    """Steps per world between two updates, unless ``clock.system`` sets the period."""

    def __post_init__(self) -> None:
        checks.above("learner.lr", self.lr, 0.0)
        checks.in_range("learner.gamma", self.gamma, 0.0, 1.0)
        checks.in_range("learner.steps", self.steps, 1)

    def check(self, setup: LearningSetup) -> None:
        """Check that this learner can learn in such a run.

        Raises:
            InputError: a setting does not fit; the message names its key.
        """

    def buffer_size(self, setup: LearningSetup) -> int | None:
        """Environment steps, over all worlds, that the replay buffer must hold; None if none is needed."""
        raise NotImplementedError

    def make(self, env: EnvBase, setup: LearningSetup, buffer: ReplayBuffer | None) -> Learner:
        """Build the learner for an environment."""
        raise NotImplementedError
