"""What a learner is: a configuration that checks and builds it, an actor to fly, and updates from batches."""

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
    """Takes batches as they are collected, and improves its actor."""

    actor: ProbabilisticActor
    """The policy that collects and that an evaluation flies."""

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a batch [B, T] of consecutive steps; returns named numbers for the log."""
        ...

    def components(self) -> dict[str, Any]:
        """Networks and optimisers that a checkpoint keeps, by name; ``actor`` among them."""
        ...


class LearningSetup(NamedTuple):
    """What a learner must know of a run beside its own settings."""

    model: ModelConfig
    """Of actor and critic."""
    worlds: int
    """B."""
    shortest_period: int
    """Fewest steps of every world between two updates."""
    longest_period: int
    """Most steps of every world between two updates."""
    longest_delay: int = 0
    """Of a message [steps]."""
    backupdate: bool = False
    """Does the replay buffer correct steps as late messages arrive."""
    settle: bool = False
    """Learn from a step only when none of its messages can be in transit any more."""
    recompute_actor: bool = False
    """Late messages also replace what the actor saw (the original authors' variant)."""
    critic_key: NestedKey = keys.GLOBAL_OBSERVATION
    """What the critic sees of each UAV."""

    @property
    def settle_steps(self) -> int:
        """How many steps later a step is learnt from."""
        return self.longest_delay if self.settle else 0


@dataclass
class LearnerConfig:
    """Settings that all learners share; ``name`` chooses the learner."""

    name: str = ""
    lr: float = 3e-4
    """Learning rate of Adam."""
    gamma: float = 0.95
    """Discount factor of a step."""
    steps: int = 32
    """Steps of every world between two updates, unless ``clock.system`` says otherwise."""

    def __post_init__(self) -> None:
        checks.above("learner.lr", self.lr, 0.0)
        checks.in_range("learner.gamma", self.gamma, 0.0, 1.0)
        checks.in_range("learner.steps", self.steps, 1)

    def check(self, setup: LearningSetup) -> None:
        """Refuse what this learner cannot do.

        Raises:
            InputError: names the key that does not fit.
        """

    def buffer_size(self, setup: LearningSetup) -> int | None:
        """Steps, over all worlds, that a replay buffer must hold; None if the learner needs no buffer."""
        raise NotImplementedError

    def make(self, env: EnvBase, setup: LearningSetup, buffer: ReplayBuffer | None) -> Learner:
        """The learner for an environment."""
        raise NotImplementedError
