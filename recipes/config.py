"""All settings of the programs but ``damian compare``: those of ``damian train``, which the others
extend."""

import warnings
from dataclasses import dataclass, replace
from typing import Any

from damian.common import checks
from damian.common.fields import Settings, constant, setting
from damian.compare.config import STORED
from damian.envs.config import ClockConfig, ScenarioConfig
from damian.learners.config import LEARNERS, LearnerConfig, MappoConfig
from damian.models.config import MODELS, MlpConfig, ModelConfig
from damian.runs.config import LoggerConfig
from damian.runs.measures import check_score

COMPILE_FROM = 1_000_000
"""Environment steps from which on compiling saves more time than it takes, half a minute."""


@dataclass
class TrainConfig(ScenarioConfig):
    """All settings of ``damian train``, beside those of the scenario."""

    learner: LearnerConfig = setting(MappoConfig)
    model: ModelConfig = setting(MlpConfig)
    critic: str = setting(
        "server",
        "The critic observes the messages that the server holds, or the true state (privileged).",
        choices=("server", "privileged"),
    )
    logger: LoggerConfig = setting(LoggerConfig)
    seed: int = setting(0, "Seed of all random draws.", low=0, high=2**31)
    worlds: int = setting(64, "Number of parallel environments.", low=1, high=checks.WORLDS)
    frames: int = setting(
        300000, "Environment steps to learn from, over all worlds.", low=1, high=1e12
    )
    episodes: int | None = setting(
        None,
        "Stop after this number of episodes, if that comes before ``frames``.",
        low=1,
        high=1e12,
    )
    eval_episodes: int = setting(200, "Episodes of each evaluation.", low=1, high=checks.WORLDS)
    metrics: list[str] = setting([], "Further metrics of evaluations, such as package.module:name.")
    eval_every: int | None = setting(
        None, "Updates between two evaluations on the way.", low=1, high=1e12
    )
    checkpoint_every: int = setting(
        20, "Updates between two checkpoints: what a killed run loses at most.", low=1, high=1e12
    )
    backupdate: bool = setting(
        False,
        "Late messages and rewards correct stored steps before the learner uses them (section 3.4).",
    )
    settle: bool = setting(
        False,
        "With ``backupdate``: learn from a step only when nothing of it can be in transit any more.",
    )
    corrected: list[str] = setting(
        ["reward", "critic"],
        "With ``backupdate``: what late messages correct: reward, critic (its observation), actor "
        "(its own).",
    )
    checkpoint: str | None = setting(
        None,
        "Run folder, its best.pt, or damian:NAME: the policy to begin with or to fly, and its "
        "settings.",
    )
    overrides: list[str] = constant(
        [], "Words of the command line, to be shown; the program fills them in."
    )
    resume: str | None = setting(None, "Run folder of the run to continue.")
    device: str = setting("cpu", "Device of all tensors: cpu, cuda, cuda:1, ...")
    threads: int = setting(
        1,
        "Threads of the learning; more help only networks much larger than the default.",
        low=1,
        high=1024,
    )
    compile: Any = setting(
        "auto",
        "Compile the steps, the actor, MAPPO's loss and the planner; auto does in a training from a "
        "million ``frames`` on.",
        choices=("auto", True, False),
    )
    trust: bool = setting(
        False, "Import the components package.module:Name that a run folder names."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for key, registry in (("learner", LEARNERS), ("model", MODELS)):
            section = getattr(self, key)
            problem = (
                f"is not the {key} of these settings: choose one with {key}={'|'.join(registry)}"
            )
            matches = type(section) is registry.get(section.name, key)
            checks.require(matches, f"{key}.name", section.name, problem)
        checks.names("corrected", self.corrected, ("reward", "critic", "actor"))
        self.refuse(not self.corrected, "corrected", "is empty: choose reward, critic or actor")
        if self.observation.belief and not self.seeks_source:  # aware=belief suits any task
            keys = "observation.belief" + " and model.prior" * self.model.prior
            warnings.warn(
                f"{keys}: left out, because nothing is won by finding the source", stacklevel=2
            )
            self.observation = replace(self.observation, belief=[])
            self.model = replace(self.model, prior=False)

    @property
    def compiles(self) -> bool:
        """Whether to compile; ``auto`` leaves out sensors of the user's own, which Inductor may
        crash on."""
        return (
            self.frames >= COMPILE_FROM and not self.sensors
            if self.compile == "auto"
            else self.compile
        )

    @property
    def update_steps(self) -> int:
        """Steps of every world before the first update: the system clock's period, or
        ``learner.steps``."""
        return self.clock.steps("system") if self.clock.system else self.learner.steps

    @property
    def eval_seed(self) -> int:
        """Seed of the initial conditions of an evaluation; they differ from those of the
        training."""
        return self.seed + 10_000

    @property
    def horizon(self) -> int:
        """Steps after which an episode of an evaluation is cut off, if nothing else ends it."""
        limit = self.episode.max_steps or 200
        return 4 * limit if self.episode.since_detection else limit


@dataclass
class PlannerConfig(Settings):
    """Settings of the planner (``damian.baselines.planner``)."""

    section = "planner"

    horizon: int = setting(4, "Steps that it looks ahead.", low=1, high=1000)
    samples: int = setting(
        1, "Copies of a world for each action, for what is drawn.", low=1, high=1000
    )


@dataclass
class EvaluateConfig(TrainConfig):
    """All settings of ``damian evaluate``: those of ``damian train``, and a further policy."""

    policy: str | None = setting(
        None, "A policy to evaluate beside the others.", choices=("planner",)
    )
    planner: PlannerConfig = setting(PlannerConfig)


@dataclass
class FlyConfig(TrainConfig):
    """All settings of ``damian fly``: those of ``damian train``, and what to fly and to keep."""

    eval_episodes: int = setting(1, "Episodes to fly.")
    policy: str | None = setting(
        None,
        "sampled (default with a checkpoint), deterministic, script (default without), random, or "
        "planner.",
        choices=(*STORED, "script", "random", "planner"),
    )
    planner: PlannerConfig = setting(PlannerConfig)
    keep: str = setting(
        "all",
        "Keep all, or the best, median and worst episode (extremes).",
        choices=("all", "extremes"),
    )
    formats: list[str] = setting(
        ["gif", "png"],
        "What to make of each: a film (gif), a figure (png), a page (html).",
        choices=("gif", "png", "html"),
    )
    shown: list[str] = setting(
        [],
        "UAVs that films tell apart, by number; if none, all of up to 6, 3 of more.",
    )
    replay: list[str] = setting(
        [], "Stored episodes to play side by side in one page, instead of flying."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.refuse(
            self.resume is not None,
            "resume",
            "is for damian train: nothing is trained here; give the run folder as checkpoint",
        )
        self.refuse(
            self.learnt and not self.checkpoint,
            "policy",
            "needs checkpoint: the run folder with the policy to fly",
        )
        self.refuse(
            self.policy and self.checkpoint and not self.learnt,
            "policy",
            "flies no checkpoint: leave it out",
        )
        known = {*self.shown} <= {*map(str, range(self.agents))}
        self.refuse(not known, "shown", f"is not a list of UAVs from 0 to {self.agents - 1}")

    @property
    def flown(self) -> str:
        """The policy that flies."""
        return self.policy or ("sampled" if self.checkpoint else "script")

    @property
    def learnt(self) -> bool:
        """Whether it is that of a checkpoint."""
        return self.flown in STORED


@dataclass
class FitConfig(Settings):
    """All settings of ``damian fit``."""

    log: str = setting("", "Journal, or table of reports with receive times, whose delays to fit.")
    clock: ClockConfig = setting(ClockConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.refuse(not self.log, "log", "is missing: the journal or table whose delays to fit")


@dataclass
class ExportConfig(Settings):
    """All settings of ``damian export``."""

    checkpoint: str | None = setting(
        None, "Run folder, its best.pt, or damian:NAME: the policy to export."
    )
    trust: bool = setting(
        False, "Import the components package.module:Name that the run folder names."
    )


@dataclass
class ResultsConfig(Settings):
    """All settings of ``damian results``."""

    folders: list[str] = setting(
        [], "Folder of a run, a sweep or a comparison; or two folders to compare."
    )
    score: str = setting("return", "Metric whose differences the table of two folders has.")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_score(self.score)
        self.refuse(
            len(self.folders) not in (1, 2), "folders", "is not one folder, or two to compare"
        )
