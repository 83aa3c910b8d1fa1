"""Settings of the programs beside ``damian train``: evaluate shares those, the others have more."""

import re
from dataclasses import dataclass
from typing import Any, ClassVar

from damian.common import checks
from damian.settings.fields import Settings, constant, setting
from damian.settings.training import TrainConfig

MISSING: Any = "???"
"""Hydra's and OmegaConf's mark of a value that must be given."""
_MEASURES = ("return", "success_rate", "steps")
SCORES = (*_MEASURES, *(f"perceived_{name}" for name in _MEASURES))
"""Measures by which arms can be compared; the first ones are from messages without delay."""
LESS_IS_BETTER = ("steps", "perceived_steps")
"""Scores for which lower values are better."""
STORED = ("sampled", "deterministic")
"""Policies of a checkpoint: its actions are drawn, or the most likely ones."""
FORMATS = ("gif", "mp4", "png", "html", "geojson")
FILMS = FORMATS[:2]
MOST_EPISODES = 12
"""Episodes that one page can play side by side."""
_HIDDEN = {"hidden": {"choices": [[64, 64], [128, 128], [256, 256]]}}
_GAMMA = {"choices": [0.8, 0.9, 0.95, 0.98, 0.99]}
_MAPPO = {
    "lr": {"low": 1e-4, "high": 1e-2, "log": True},
    "entropy_coeff": {"low": 1e-4, "high": 1e-1, "log": True},
    "gamma": _GAMMA,
    "lmbda": {"choices": [0.8, 0.9, 0.95]},
    "epochs": {"low": 2, "high": 10},
    "minibatches": {"choices": [2, 4, 8]},
}
_SAC = {
    "lr": {"low": 1e-4, "high": 3e-3, "log": True},
    "alpha_lr": {"low": 1e-3, "high": 1e-1, "log": True},
    "target_entropy": {"low": 0.1, "high": 0.9},
    "gamma": _GAMMA,
    "tau": {"low": 2e-3, "high": 5e-2, "log": True},
    "batch_size": {"choices": [256, 512, 1024]},
}
_PREDICTIVE = {
    "prediction_lr": {"low": 5e-4, "high": 1e-2, "log": True},
    "width": {"choices": [16, 32, 64]},
}
SEARCHES: dict[str, dict[str, Any]] = {
    "mappo": {"learner": _MAPPO, "model": _HIDDEN},
    "predictive_mappo": {
        "learner": {**_MAPPO, **_PREDICTIVE},
        "model": _HIDDEN,
        "delay": {"messages": {"choices": [4, 8, 12]}},
    },
    "sac": {"learner": _SAC, "model": _HIDDEN},
    "bpql": {"learner": _SAC, "model": _HIDDEN, "delay": {"history": {"choices": [2, 4, 8, 12]}}},
}
"""What ``damian tune`` varies, by the learner."""
SEEDS = 10
"""Seeds of a comparison, if their number is not given; with fewer, a report is marked as developing."""
TAKEN = ("none", "random", "script")
"""Names of an undelayed arm's delay and of the policies that fly beside each arm."""
SET_BY_COMPARISON = ("seed", "resume", "checkpoint", "logger", "hydra")
"""Keys that a comparison sets for each of its runs."""
SCORE_MEANS = "The measure that counts, of what truly happened, or as the server perceived it."
POLICY_MEANS = "The evaluated policy: actions drawn (sampled), or the most likely ones (deterministic)."


@dataclass
class FlownPolicyConfig(TrainConfig):
    """All settings of ``damian train``, and which policy flies."""

    policy: str | None = None

    policies: ClassVar[tuple[str, ...]] = STORED
    """The policies that the program knows; the first of them flies a checkpoint if none is chosen."""

    def __post_init__(self) -> None:
        super().__post_init__()
        problem = "is for damian train: nothing is trained here; give the run folder as checkpoint"
        self.refuse(self.resume is not None, "resume", problem)
        if self.policy is not None:
            checks.one_of("policy", self.policy, self.policies)
        problem = "needs checkpoint: the run folder with the policy to fly"
        self.refuse(self.learnt and not self.checkpoint, "policy", problem)
        problem = "flies no checkpoint: leave it out"
        self.refuse(self.policy and self.checkpoint and not self.learnt, "policy", problem)

    @property
    def flown(self) -> str:
        """The policy that flies, one of ``policies``."""
        return self.policy or (self.policies[0] if self.checkpoint else "script")

    @property
    def learnt(self) -> bool:
        """Whether it is that of a checkpoint."""
        return self.flown in STORED


@dataclass
class FlyConfig(FlownPolicyConfig):
    """All settings of ``damian fly``: those of ``damian train``, and what to fly and to keep."""

    eval_episodes: int = setting(1, "Episodes to fly.")
    policy: str | None = setting(
        None, "sampled (default with a checkpoint), deterministic, script (default without), or random."
    )
    keep: str = setting(
        "all",
        "Episodes to keep: all, or the best, the median and the worst (extremes).",
        choices=("all", "extremes"),
    )
    formats: list[str] = setting(
        ["gif", "png"],
        "What to make of each: films (gif, mp4), a figure (png), a page (html), or geojson for map tools.",
        choices=FORMATS,
    )
    views: list[str] = setting(["2d"], "Views of the films: from above, or in space.", choices=("2d", "3d"))
    journal: str | None = setting(
        None, "Journal of ``damian advise`` whose flight to show, instead of flying; its settings apply."
    )
    span: list[float] | None = setting(
        None, "First and last time of the journal to show, since every UAV had reported [s]."
    )
    replay: list[str] = setting([], "Stored episodes to play side by side in one page, instead of flying.")

    policies: ClassVar[tuple[str, ...]] = ("sampled", "deterministic", "script", "random")

    def __post_init__(self) -> None:
        super().__post_init__()
        self.refuse(self.journal and self.replay, "replay", "does not go with journal: leave one out")
        if self.journal or self.replay:
            flies = {"checkpoint": None, "policy": None, "eval_episodes": 1, "keep": "all"}
            for name, none in flies.items():
                wrong = getattr(self, name) != none
                self.refuse(wrong, name, "means nothing with journal or replay, which fly nothing")
        problem = f"is more than {MOST_EPISODES} episodes"
        self.refuse(len(self.replay) > MOST_EPISODES, "replay", problem)
        if self.span is not None:
            good = len(self.span) == 2 and 0 <= self.span[0] < self.span[1] and self.journal
            self.refuse(not good, "span", "is not [FIRST, LAST], two times of a journal [s]")
        films = {*self.formats} & {*FILMS}
        self.refuse(films and not self.views, "views", "names no view for the films: choose 2d or 3d")


@dataclass
class FieldRules(Settings):
    """What a service of real UAVs holds to, whatever the policy chooses."""

    acknowledge: bool = setting(
        True, "Whether a UAV counts as following an answer only once it has accepted it; false: at once."
    )
    answer_time: float = setting(10.0, "How long an answer holds; it must be accepted by then [s].", above=0)
    reserve: float = setting(
        20.0, "Battery level below which a UAV holds or returns; 0 needs no reported battery [%].", high=100
    )
    oldest_report: float = setting(60.0, "Age of its newest report above which a UAV holds [s].", above=0)
    lowest_level: float = setting(20.0, "Lowest flight level above ground [m].", above=0)
    highest_level: float = setting(
        120.0, "Highest flight level; UAVs share levels if there are too few [m].", above=0
    )
    level_step: float = setting(5.0, "Vertical distance between two flight levels [m].", above=0)
    clearance: float = setting(
        10.0, "Distance that paths of UAVs at the same level keep from each other; else one holds [m].", low=0
    )
    instant: bool = setting(
        False, "Whether to serve a policy whose UAVs were at their targets at once in training."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.in_range("highest_level", self.highest_level, self.lowest_level, unit="m")

    @property
    def levels(self) -> list[float]:
        """The flight levels [m], from the lowest upward."""
        n_levels = int((self.highest_level - self.lowest_level) / self.level_step + 1e-9) + 1
        return [self.lowest_level + i * self.level_step for i in range(n_levels)]


@dataclass
class AdviseConfig(FlownPolicyConfig, FieldRules):
    """All settings of ``damian advise``: those of ``damian train``, and where reports come from."""

    policy: str | None = setting(None, "deterministic (default with checkpoint), sampled, or script.")
    reports: str | None = setting(None, "Table of reports to answer once, CSV or JSON.")
    port: int | None = setting(None, "Port of the service over HTTP; 0: a free one.", low=0, high=65535)
    fit: str | None = setting(
        None, "Journal, or table with receive times: only write its delays as a trace, ``trace.csv``."
    )
    host: str = setting("127.0.0.1", "Address of the service; other machines do not reach the default one.")
    token: str | None = setting(
        None, "Password of the service; DAMIAN_TOKEN of the environment, or made and printed, if not given."
    )
    uavs: list[str] = setting([], "IDs of the UAVs of a table; those in it if not given.")
    journal: str | None = setting(None, "Folder of the journals; in the run folder if not given.")

    policies: ClassVar[tuple[str, ...]] = ("deterministic", "sampled", "script")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_token("token", self.token)

    def check_source(self) -> None:
        """Require exactly one source of reports."""
        given = [name for name in ("reports", "port", "fit") if getattr(self, name) is not None]
        problem = "is not the only one of reports=FILE, port=NUMBER, fit=FILE: give one"
        checks.require(len(given) == 1, "reports", " and ".join(given) or "nothing", problem)
        unread = self.journal and given[0] in ("reports", "fit")
        self.refuse(unread, "journal", "is for a service: leave it out")


def check_token(key: str, token: str | None) -> None:
    """Require a password that nobody guesses and every header can carry, if there is one."""
    good = token is None or (len(token) >= 16 and token.isascii() and token.isprintable())
    checks.require(good, key, "it", "is not a password of at least 16 printable ASCII characters")


@dataclass
class TuneConfig(TrainConfig):
    """All settings of ``damian tune``: those of ``damian train``, and how to search."""

    search: dict[str, Any] = setting(
        {}, "What to vary, each setting as {low: 1, high: 8, log: true, step: 1} or {choices: [...]}."
    )
    trials: int = setting(30, "Number of trainings.", low=1, high=1_000_000)
    processes: int = setting(1, "Trainings at the same time, of one thread each.", low=1, high=1024)
    score: str = setting("return", SCORE_MEANS, choices=SCORES)
    policy: str = setting("sampled", POLICY_MEANS, choices=STORED)

    def __post_init__(self) -> None:
        super().__post_init__()
        alike = self.episode.success_share is None and "success" in self.score
        self.refuse(alike, "score", "is the same for every policy: in this task nothing can be reached")
        for name in ("checkpoint", "resume"):
            problem = "is not for a search, which trains every policy from the beginning: leave it out"
            self.refuse(getattr(self, name) is not None, name, problem)

    @property
    def sign(self) -> int:
        """1 if the greatest score is the best, -1 if the least is."""
        return -1 if self.score in LESS_IS_BETTER else 1


@dataclass
class Arm(Settings):
    """One way to train policies for a task, or to fly those of another arm."""

    overrides: list[str] = setting([], "Overrides of the settings of ``damian train``.")
    delayed: bool = setting(True, "Whether it has delays; exactly one arm, the reference, has none.")
    naive: bool = setting(False, "Whether it ignores the delay; the best such arm has recovery 0.")
    policy_of: str | None = setting(None, "Arm whose policies it flies, without any training of its own.")
    starts_from: str | None = setting(None, "Arm from whose policies, of the same seed, its training starts.")
    teacher: str | None = setting(None, "Arm whose policies its learner imitates: its ``learner.teacher``.")
    untrained: bool = setting(False, "Whether the networks fly as they are before the first update.")
    tasks: list[str] | None = setting(None, "Tasks that the arm does; all of them if not given.")
    regime: str = setting(
        "",
        "Information in training: R0 messages, R1 truth for the critic, R2 no delay; R3: never any delay.",
        choices=("", "R0", "R1", "R2", "R3"),
    )

    @property
    def source(self) -> str | None:
        """Arm whose policies it flies, starts from, or imitates."""
        return self.policy_of or self.starts_from or self.teacher


@dataclass
class HeldOut(Settings):
    """Changes of a task under which the policies that were trained without them are evaluated too."""

    overrides: list[str] = setting([], "Overrides of ``damian train``, such as another region.")
    tasks: list[str] | None = setting(None, "Tasks to change; all of them if not given.")
    delays: list[str] | None = setting(None, "Delays of the training; all of them if not given.")
    arms: list[str] | None = setting(None, "Arms whose policies are flown; all of them if not given.")


@dataclass
class Experiment(Settings):
    """Tasks, delays and arms to compare, as written in a file of conf/experiment."""

    section: ClassVar[str] = "experiment"

    tasks: dict[str, list[str]] = setting({}, "Overrides of ``damian train`` for each task.")
    delays: dict[str, list[str]] = setting({}, "Overrides of ``damian train`` for each delay.")
    arms: dict[str, Arm] = setting({}, "Ways to train or fly; one of them has ``delayed: false``.")
    held_out: dict[str, HeldOut] = setting({}, "Changed tasks, TASK@NAME, to evaluate all policies in.")
    first_seed: int = setting(0, "The seeds of every arm count from this one.", low=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        for kind in ("tasks", "delays", "arms", "held_out"):
            for name in getattr(self, kind):
                good = re.fullmatch(r"[\w.+-]+", name) and name not in TAKEN
                should = "cannot name a folder: use letters, digits, _ . + - but not none, random or script"
                checks.require(bool(good), f"experiment.{kind}", name, should)
        for kind in ("tasks", "arms"):
            self.refuse(
                not getattr(self, kind), kind, "is missing or empty; an experiment needs at least one"
            )
        self._check_arms()
        for name, held_out in self.held_out.items():
            for kind in ("tasks", "delays", "arms"):
                for each in getattr(held_out, kind) or ():
                    checks.one_of(f"experiment.held_out.{name}.{kind}", each, getattr(self, kind))

    def _check_arms(self) -> None:
        undelayed = [name for name, arm in self.arms.items() if not arm.delayed]
        should = "are not delayed: exactly one arm must have delayed=false"
        checks.require(len(undelayed) == 1, "experiment.arms", undelayed, should)
        never = not self.delays and len(self.arms) > len(undelayed)
        self.refuse(never, "delays", "is empty, but there are delayed arms")
        for name, arm in self.arms.items():
            key, good = f"experiment.arms.{name}", arm.delayed and arm.policy_of is None
            should = "goes with neither policy_of nor delayed=false"
            checks.require(good or not arm.untrained, key, "untrained", should)
            source = self.arms.get(arm.source or "", arm)
            for task in self.tasks if arm.tasks is None else arm.tasks:
                options = self.tasks if source.tasks is None else source.tasks
                checks.one_of(f"{key}.tasks", task, options)


@dataclass
class CompareConfig(Settings):
    """All settings of ``damian compare``."""

    experiment: Experiment = MISSING
    seeds: int | None = setting(
        None, "Number of seeds; if not given 10, or with ``report_only`` all stored ones.", low=1, high=10_000
    )
    processes: int = setting(1, "Runs at the same time, of one thread each.", low=1, high=1024)
    tasks: list[str] | None = setting(None, "Tasks to run; all of the experiment's if not given.")
    delays: list[str] | None = setting(None, "Delays to run; all of the experiment's if not given.")
    arms: list[str] | None = setting(None, "Arms to run; all of the experiment's if not given.")
    overrides: list[str] = setting([], "Further overrides of ``damian train`` for every run.")
    score: str = setting("return", SCORE_MEANS, choices=SCORES)
    policy: str = setting("sampled", POLICY_MEANS, choices=STORED)
    report_only: bool = setting(False, "Run nothing; write tables and figures from stored results.")
    keep: bool = setting(
        False, "Keep the stored results of runs whose folders are gone, and run only the others."
    )
    own_folder: str | None = constant(None, "The folder after --config-dir; the program fills it in.")

    def __post_init__(self) -> None:
        super().__post_init__()
        for word in self.overrides:
            ours = word.lstrip("+~").partition("=")[0].partition(".")[0] in SET_BY_COMPARISON
            problem = "cannot be the same for every run: the comparison sets it; leave it out"
            checks.require(not ours, "overrides", word, problem)
        for kind in ("tasks", "delays", "arms"):
            none = getattr(self, kind) == [] and kind != "delays"
            checks.require(not none, kind, [], "names none: leave it out, for all of them")
            for name in getattr(self, kind) or ():
                checks.one_of(kind, name, getattr(self.experiment, kind))
        arms = self.chosen("arms")
        trained = [n for n, a in arms.items() if not (a.policy_of or a.untrained)]
        for name, arm in arms.items():
            for kind in ("policy_of", "starts_from", "teacher"):
                if getattr(arm, kind) is not None:
                    checks.one_of(f"experiment.arms.{name}.{kind}", getattr(arm, kind), trained)

    def chosen(self, kind: str) -> dict[str, Any]:
        """The experiment's tasks, delays or arms (``kind``) that are asked for, by name."""
        every, only = getattr(self.experiment, kind), getattr(self, kind)
        return {name: every[name] for name in every if only is None or name in only}

    @property
    def every_seed(self) -> range:
        """The seeds that are asked for."""
        n_seeds = SEEDS if self.seeds is None else self.seeds
        return range(self.experiment.first_seed, self.experiment.first_seed + n_seeds)
