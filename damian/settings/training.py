"""All settings of ``damian train``."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

from damian.common import checks
from damian.settings.fields import Settings, constant, setting
from damian.settings.learners import LEARNERS, LearnerConfig, MappoConfig, ModelConfig
from damian.settings.scenario import ScenarioConfig

COMPILE_FROM = 1_000_000
"""Environment steps from which on compiling saves more time than it takes, half a minute."""


@dataclass
class WandbConfig(Settings):
    """What ``logger=wandb`` is told."""

    section: ClassVar[str] = "logger.wandb"

    project: str = setting("damian", "Project of Weights & Biases.")
    offline: bool = setting(
        False, "Keep everything in the run folder, for ``wandb sync``; so does WANDB_MODE=offline."
    )


@dataclass
class LoggerConfig(Settings):
    """Which files of metrics the training writes into the run folder."""

    section: ClassVar[str] = "logger"

    tensorboard: bool = setting(True, "Write TensorBoard events.")
    csv: bool = setting(True, "Write ``metrics.csv``.")
    wandb: WandbConfig = setting(WandbConfig)
    custom: list[Any] = setting(
        [], "Loggers of your own: package.module:Name, or {logger: package.module:Name, parameter: ...}."
    )


@dataclass
class TrainConfig(ScenarioConfig):
    """All settings of ``damian train``, beside those of the scenario."""

    learner: LearnerConfig = setting(MappoConfig)
    model: ModelConfig = setting(ModelConfig)
    critic: str = setting(
        "server",
        "The critic observes the messages that the server holds, or the true state (privileged, regime R1).",
        choices=("server", "privileged"),
    )
    logger: LoggerConfig = setting(LoggerConfig)
    seed: int = setting(0, "Seed of all random draws.", low=0, high=2**31)
    worlds: int = setting(64, "Number of parallel environments.", low=1, high=checks.WORLDS)
    frames: int = setting(300000, "Environment steps to learn from, over all worlds.", low=1, high=1e12)
    episodes: int | None = setting(
        None, "Stop after this number of episodes, if that comes before ``frames``.", low=1, high=1e12
    )
    eval_episodes: int = setting(200, "Episodes of each evaluation.", low=1, high=checks.WORLDS)
    eval_every: int | None = setting(None, "Updates between two evaluations on the way.", low=1, high=1e12)
    checkpoint_every: int = setting(
        20, "Updates between two checkpoints: what a killed run loses at most.", low=1, high=1e12
    )
    backupdate: bool = setting(
        False, "Late messages and rewards correct stored steps before the learner uses them (section 3.4)."
    )
    settle: bool = setting(
        False, "With ``backupdate``: learn from a step only when nothing of it can be in transit any more."
    )
    corrected: list[str] = setting(
        ["reward", "critic"],
        "With ``backupdate``: what late messages correct: reward, critic (its observation), actor (its own).",
    )
    checkpoint: str | None = setting(
        None, "Run folder, or the best.pt in it, of the policy to begin with or to fly; its overrides apply."
    )
    overrides: list[str] = constant([], "Words of the command line; the program fills them in.")
    resume: str | None = setting(None, "Run folder of the run to continue.")
    device: str = setting("cpu", "Device of all tensors: cpu, cuda, cuda:1, ...")
    threads: int = setting(
        1, "Threads of the learning; more help only networks much larger than the default.", low=1, high=1024
    )
    compile: Any = setting(
        "auto",
        "Compile the steps, the actor and MAPPO's loss; auto does from a million ``frames`` on.",
        choices=("auto", True, False),
    )
    trust: bool = setting(False, "Import the components package.module:Name that a run folder names.")

    def __post_init__(self) -> None:
        super().__post_init__()
        matches = type(self.learner) is LEARNERS.get(self.learner.name, "learner")
        problem = f"is not the learner of these settings: choose one with learner={'|'.join(LEARNERS)}"
        checks.require(matches, "learner.name", self.learner.name, problem)
        checks.names("corrected", self.corrected, ("reward", "critic", "actor"))
        self.refuse(not self.corrected, "corrected", "is empty: choose reward, critic or actor")
        if not self.seeks_source:  # aware=belief suits any task: observe no belief by which nothing is won
            self.observation = replace(self.observation, belief=[])
            self.model = replace(self.model, skip=False)

    @property
    def compiles(self) -> bool:
        """Whether to compile; ``auto`` leaves out sensors of the user's own, which Inductor may crash on."""
        return self.frames >= COMPILE_FROM and not self.sensors if self.compile == "auto" else self.compile

    @property
    def update_steps(self) -> int:
        """Steps of every world before the first update: the system clock's period, or ``learner.steps``."""
        return self.clock.steps("system") if self.clock.system else self.learner.steps

    @property
    def eval_scenario(self) -> ScenarioConfig:
        """The scenario of an evaluation; it skips no steps, because every step is measured."""
        return replace(self, clock=replace(self.clock, skip=False, skip_discount=1.0))

    @property
    def train_scenario(self) -> ScenarioConfig:
        """The scenario of the training; rewards of skipped steps are discounted by ``learner.gamma``."""
        discount = self.learner.gamma if self.clock.skip else 1.0
        return replace(self, clock=replace(self.clock, skip_discount=discount))

    @property
    def eval_seed(self) -> int:
        """Seed of the initial conditions of an evaluation; they differ from those of the training."""
        return self.seed + 10_000

    @property
    def horizon(self) -> int:
        """Steps after which an episode of an evaluation is cut off, if nothing else ends it."""
        limit = self.episode.max_steps or 200
        return 4 * limit if self.episode.since_detection else limit
