"""Settings of learners, which name the class that learns with them."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from damian import keys
from damian.common import checks
from damian.common.fields import Settings, constant, setting
from damian.common.registry import Registry, resolved
from damian.models.config import ModelConfig

if TYPE_CHECKING:
    from tensordict import NestedKey
    from torchrl.data import ReplayBuffer
    from torchrl.envs import EnvBase
    from torchrl.modules import ProbabilisticActor


def _is_learner(found: Any) -> bool:
    derived = isinstance(found, type) and issubclass(found, LearnerConfig)
    declared = derived and "__dataclass_fields__" in vars(found)
    return declared and bool(found.learner or found.make is not LearnerConfig.make)


LEARNERS = Registry[type["LearnerConfig"]](
    "learner",
    _is_learner,
    "is not a @dataclass derived from damian.LearnerConfig with a method make",
)
"""Settings of learners, by name; the user's own as ``package.module:Name``."""


class LearningSetup(NamedTuple):
    """Properties of a run that a learner needs besides its own settings."""

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
    """Whether the replay buffer corrects stored steps as late messages arrive
    (paper, section 3.4)."""
    settle: bool = False
    """Whether to learn from a step only when neither its messages nor its reward can be in
    transit."""
    recompute_actor: bool = False
    """Whether late messages also replace the actor's observations
    (the original authors' variant)."""
    critic_key: "NestedKey" = keys.GLOBAL_OBSERVATION
    """Key of the critic's observation."""
    compile: bool = False
    """Whether to compile the loss, so that updates are faster once it is compiled."""
    frames: int = 300_000
    """Environment steps of the run, over all worlds."""
    action_delay: int | None = 0
    """Delay of every action that arrives [steps]; None if it differs between actions."""

    @property
    def settle_steps(self) -> int:
        """Number of steps by which learning from a step is postponed."""
        return self.longest_delay if self.settle else 0

    @property
    def least_buffer(self) -> int:
        """Environment steps that back-updating needs in the buffer: a period and twice the longest
        delay."""
        return (self.longest_period + 2 * self.longest_delay) * self.worlds


@dataclass
class LearnerConfig(Settings):
    """Settings of a learner, which make it; those that all learners share.

    A learner of your own has a dataclass derived from this class, with fields for its own settings,
    that implements ``make``. Whatever changes in the learner must be among its ``components``, or a
    resumed run loses it. The settings ``learner=package.module:Name learner.lr=1e-3`` choose it."""

    section: ClassVar[str] = "learner"

    name: str = setting(
        "", "Name of the learner, or package.module:Name; the group ``learner`` sets it."
    )
    lr: float = setting(0.0003, "Learning rate of Adam.", above=0, high=1)
    gamma: float = setting(0.95, "Discount factor per step.", low=0, high=1)
    steps: int = setting(
        32, "Steps between two updates, if clock.system is not set.", low=1, high=checks.STEPS
    )
    team: float = setting(
        0.0,
        "Share of the mean reward of all UAVs in what each learns from, instead of its own.",
        low=0,
        high=1,
    )
    talks: bool = setting(
        False, "Whether an actor may read the rows of other UAVs, who then talk without delay."
    )

    reads: ClassVar[tuple[str, ...]] = ()
    """Optional outputs of the environment that the learner needs in its batches: ``message``,
    ``state``, ``reward_terms`` or ``privileged`` (``damian.make_env``); ``timeline``: what
    ``delay.messages`` adds; and
    ``hindsight``: with back-updating, stored steps then also hold the newest message that has
    arrived since (``keys.HINDSIGHT``)."""
    actor_follows_critic: ClassVar[bool] = False
    """Whether the sizes of the actor's layers also follow from what the critic observes."""
    learner: ClassVar[str] = ""
    """Path of the class that ``make`` builds, from environment, settings, setup and replay
    buffer."""

    @classmethod
    def class_for(cls, values: Mapping[str, Any]) -> type[Settings]:
        return LEARNERS.get(values.get("name"), "learner")

    def check(self, setup: LearningSetup) -> None:
        """Check that this learner can learn in such a run.

        Raises:
            InputError: a setting does not fit; the message names its key.
        """

    def buffer_size(self, setup: LearningSetup) -> int | None:
        """Environment steps, over all worlds, that the replay buffer must hold; None if none is
        needed."""
        return None

    def make(self, env: "EnvBase", setup: LearningSetup, buffer: "ReplayBuffer | None") -> Any:
        """Build the learner (``damian.learners.base.Learner``) for an environment.

        Args:
            env: environment of the training, with batch size [B].
            setup: properties of the run.
            buffer: replay buffer of ``buffer_size`` steps, on a ``TimeStorage``, or with
                back-updating on a ``BackupdateStorage``, which corrects what is stored; None if
                ``buffer_size`` is None.
        """
        return resolved(self.learner)(env, copy.deepcopy(self), copy.deepcopy(setup), buffer)

    def make_actor(self, env: "EnvBase", model: ModelConfig) -> "ProbabilisticActor":
        """Build an actor as the learner has it, for evaluations, which load its weights."""
        return resolved("damian.models.actor:make_actor")(env, model)


@LEARNERS.register("mappo")
@dataclass
class MappoConfig(LearnerConfig):
    """Multi-agent PPO (Yu et al. 2022) with one shared policy."""

    name: str = "mappo"
    lmbda: float = setting(0.9, "Lambda of the generalised advantage estimate.", low=0, high=1)
    clip_epsilon: float = setting(0.2, "Clipping of the importance ratio.", low=0, high=1)
    entropy_coeff: float = setting(0.01, "Weight of the entropy bonus.", low=0)
    critic_coeff: float = constant(0.5, "Weight of the critic's loss, which Adam cancels.", low=0)
    max_grad_norm: float = setting(
        0.5, "Largest norm of the gradient, which is scaled down.", above=0
    )
    epochs: int = setting(4, "Passes over the batch per update.", low=1, high=checks.STEPS)
    minibatches: int = setting(4, "Minibatches per pass.", low=1, high=checks.STEPS)
    normalize_advantage: bool = setting(
        True, "Scale the advantages of a batch to mean 0 and deviation 1."
    )
    normalize_value: bool = setting(
        False,
        "The critic learns values of mean 0 and deviation 1, whatever the scale of the rewards.",
    )
    credit_executed: bool = setting(
        True,
        "Whether a choice earns what follows the execution of its action, if all actions that "
        "arrive are executed equally late; else what follows the choice.",
    )
    warm_up: int = setting(0, "Updates in which only the critic learns.", low=0, high=checks.STEPS)
    anneal: bool = setting(
        False, "The learning rate and the entropy bonus fall to zero over the run."
    )
    teacher: str | None = setting(
        None,
        "Whose choices the policy imitates first: the script's or the planner's, for whom nothing "
        "is late.",
        choices=("script", "planner"),
    )
    imitate: int = setting(
        50_000, "Environment steps in which the policy does nothing but imitate.", low=1
    )
    teacher_fades: int = setting(
        100_000, "Environment steps after these in which imitation fades.", low=1
    )

    learner: ClassVar[str] = "damian.learners.mappo:Mappo"

    @property
    def reads(self) -> tuple[str, ...]:  # type: ignore[override]
        """A teacher reads messages."""
        return ("message",) if self.teacher else ()

    def check(self, setup: LearningSetup) -> None:
        recurrent = setup.model.recurrent
        shortest = setup.shortest_period
        longest = setup.longest_delay
        most_minibatches = setup.worlds if recurrent else setup.worlds * shortest
        checks.in_range("learner.minibatches", self.minibatches, 1, most_minibatches)
        should = (
            f"needs more than {longest} steps (longest delay) per update (learner.steps), not "
            f"{shortest}"
        )
        checks.require(not setup.settle or longest < shortest, "settle", True, should)
        should = f"needs more than {self.credit_delay(setup)} steps per update (learner.steps)"
        fits = self.credit_delay(setup) < shortest
        checks.require(fits, "learner.credit_executed", True, should)
        should = "does not go with model.rnn: hidden states are not recomputed"
        checks.require(not (recurrent and setup.recompute_actor), "corrected", "actor", should)
        on_time = setup.action_delay == 0
        should = "knows what to choose where actions are not delayed"
        checks.require(not self.teacher or on_time, "learner.teacher", self.teacher, should)

    def credit_delay(self, setup: LearningSetup) -> int:
        """Steps after a choice from which on it earns rewards."""
        return (setup.action_delay or 0) if self.credit_executed else 0

    def buffer_size(self, setup: LearningSetup) -> int | None:
        return setup.least_buffer if setup.backupdate else None


@LEARNERS.register("sac")
@dataclass
class SacConfig(LearnerConfig):
    """Soft actor-critic (Haarnoja et al. 2018; discrete: Christodoulou 2019) with one shared
    policy."""

    name: str = "sac"
    lr: float = 0.001
    steps: int = 4
    alpha_lr: float = setting(
        0.01, "Learning rate of the temperature's logarithm.", above=0, high=1
    )
    alpha_init: float = setting(0.01, "Initial temperature (weight of the entropy).", above=0)
    tau: float = setting(
        0.01, "Share by which the target networks follow in each update.", above=0, high=1
    )
    target_entropy: float = setting(
        0.5,
        "Target entropy of discrete actions, as a share of that of a uniform choice.",
        low=0,
        high=1,
    )
    updates: int = setting(4, "Updates per round.", low=1, high=checks.STEPS)
    batch_size: int = setting(512, "Decisions per update.", low=1, high=checks.STEPS)
    buffer_steps: int = setting(200000, "Environment steps in the replay buffer.", low=1)
    warm_up: int = setting(5000, "Environment steps before learning begins.", low=0)

    learner: ClassVar[str] = "damian.learners.sac:Sac"

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.in_range("learner.warm_up", self.warm_up, 0, self.buffer_steps)

    def check(self, setup: LearningSetup) -> None:
        should = "is for learner=mappo only"
        checks.require(not setup.model.recurrent, "model.rnn", setup.model.rnn, should)
        checks.require(not setup.model.shared_value, "model.shared_value", True, should)
        checks.require(not setup.recompute_actor, "corrected", "actor", should)
        checks.in_range("learner.buffer_steps", self.buffer_steps, setup.least_buffer, unit="steps")
        checks.in_range("learner.warm_up", self.warm_up, 0, self.buffer_size(setup), unit="steps")

    def critic_keys(self, setup: LearningSetup) -> "list[NestedKey]":
        """Entries that the critics read, besides the action.

        Only the actor's observation holds the UAV's past actions: if a critic of late observations
        did not read them, the actor could not learn to use them.
        """
        return list(dict.fromkeys((setup.critic_key, keys.OBSERVATION)))

    def buffer_size(self, setup: LearningSetup) -> int:
        return self.buffer_steps // setup.worlds * setup.worlds


@LEARNERS.register("bpql")
@dataclass
class BpqlConfig(SacConfig):
    """BPQL (Kim et al. 2023): soft actor-critic with critics that are free of delay.

    The actor reads the newest observation that has arrived and its own actions since
    (``aware=backupdate+history``). The critics read nothing but the state in which the action was
    chosen,
    which the replay buffer knows by the time of learning: Q(s, a), with a from the policy at what
    the actor observed. Those of ``learner=sac`` also read what the actor observed. A step is learnt
    from when all of its messages must have arrived, as with ``settle=true``.

    The state is the entry ``LearningSetup.critic_key``. It has no actions that wait for their
    execution: with ``delay.act`` the critics do not know these."""

    name: str = "bpql"

    def critic_keys(self, setup: LearningSetup) -> "list[NestedKey]":
        return [setup.critic_key]

    def check(self, setup: LearningSetup) -> None:
        super().check(setup)
        true = (
            setup.longest_delay == 0
            or setup.backupdate
            or setup.critic_key != keys.GLOBAL_OBSERVATION
        )
        should = (
            "needs back-updating, which gives its critics what has arrived: "
            "aware=backupdate+history"
        )
        checks.require(true, "learner", self.name, should)

    def make(self, env: "EnvBase", setup: LearningSetup, buffer: "ReplayBuffer | None") -> Any:
        return super().make(env, setup._replace(settle=True), buffer)
