"""Settings of the programs beside ``damian train``: evaluate shares those, the others have more."""

import re
from dataclasses import dataclass
from typing import Any, ClassVar

from damian.common import checks
from damian.common.errors import InputError
from damian.settings.fields import Settings, setting
from damian.settings.training import TrainConfig

MISSING: Any = "???"
"""Hydra's and OmegaConf's mark of a value that must be given."""

TRUE_SCORES = ("return", "success_rate", "steps")
"""Measures of an evaluation from messages without delay."""
PERCEIVED_SCORES = ("perceived_return", "perceived_success_rate", "perceived_steps")
"""The same measures as the server perceived them."""
SCORES = (*TRUE_SCORES, *PERCEIVED_SCORES)
"""Measures by which arms can be compared."""
LESS_IS_BETTER = ("steps", "perceived_steps")
"""Scores for which lower values are better."""
STORED = ("sampled", "deterministic")
"""Policies of a checkpoint: its actions are drawn, or the most likely ones."""
KEPT = ("all", "extremes")
FORMATS = ("gif", "mp4", "png", "html", "geojson")
FILMS = FORMATS[:2]
VIEWS = ("2d", "3d")
MOST_EPISODES = 12
"""Episodes that one page can play side by side."""
LAUNCHERS = ("local", "slurm")
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


@dataclass
class FlownPolicyConfig(TrainConfig):
    """All settings of ``damian train``, and which policy flies."""

    policy: str | None = None

    policies: ClassVar[tuple[str, ...]] = STORED
    """The policies that the program knows; the first of them flies a checkpoint if none is chosen."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.resume is not None:
            raise InputError("resume: nothing is trained; give the run folder as checkpoint")
        if self.policy is None:
            return
        checks.one_of("policy", self.policy, self.policies)
        stored = "|".join(name for name in self.policies if name in STORED)
        problem = f"flies no checkpoint: choose policy={stored}, or leave out checkpoint"
        checks.require(self.learnt or not self.checkpoint, "policy", self.policy, problem)
        problem = "needs checkpoint: the run folder with the policy to fly"
        checks.require(bool(self.checkpoint) or not self.learnt, "policy", self.policy, problem)

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

    eval_episodes: int = setting(
        1,
        "Episodes to fly.",
    )
    policy: str | None = setting(
        None,
        "The policy of ``checkpoint``: ``sampled`` actions, or its most likely ones (``deterministic``); the "
        "``script``; or ``random``. If it is not given: ``sampled`` with a checkpoint, ``script`` without.",
    )
    keep: str = setting(
        "all",
        "Which episodes to keep: ``all``, or the ``extremes``: the best, the median and the worst by return.",
        choices=KEPT,
    )
    formats: list[str] = setting(
        ["gif", "png"],
        "What to make of each: films as ``gif`` or ``mp4`` (which needs ffmpeg), the figure ``png``, "
        "``html``, a page that plays it in any browser, and ``geojson`` for map tools, over a real "
        "region.",
        choices=FORMATS,
    )
    views: list[str] = setting(
        ["2d"],
        "Views of the films: ``2d``, from above, and ``3d``, with the space above the region.",
        choices=VIEWS,
    )
    journal: str | None = setting(
        None,
        "Journal of ``damian advise`` whose flight to show, instead of flying; its settings apply too.",
    )
    span: list[float] | None = setting(
        None,
        "First and last time of the journal to show, since every UAV had reported [s]; all if not given.",
    )
    replay: list[str] = setting(
        [],
        "Files of stored episodes to play side by side in one page, instead of flying.",
    )

    policies: ClassVar[tuple[str, ...]] = ("sampled", "deterministic", "script", "random")

    def __post_init__(self) -> None:
        super().__post_init__()
        sources = [name for name in ("journal", "replay") if getattr(self, name)]
        problem = "does not go with journal: leave one out"
        checks.require(len(sources) < 2, "replay", self.replay, problem)
        for source in sources:
            for key, none in (("checkpoint", None), ("policy", None), ("eval_episodes", 1), ("keep", "all")):
                given, problem = getattr(self, key), f"means nothing with {source}, which flies nothing"
                checks.require(given == none, key, given, problem)
        if self.replay:
            checks.in_range("replay", len(self.replay), 1, MOST_EPISODES, "episodes")
        if self.span is not None:
            good = len(self.span) == 2 and 0 <= self.span[0] < self.span[1] and self.journal is not None
            checks.require(good, "span", self.span, "is not [FIRST, LAST], two times of a journal [s]")
        films = [kind for kind in self.formats if kind in FILMS]
        problem = f"names no view for the films that formats={films} asks for: choose 2d or 3d"
        checks.require(bool(self.views) or not films, "views", [], problem)


@dataclass
class AdviseConfig(FlownPolicyConfig):
    """All settings of ``damian advise``: those of ``damian train``, and where reports come from."""

    policy: str | None = setting(
        None,
        "The policy of ``checkpoint``: its most likely actions (``deterministic``), or ``sampled`` ones; or "
        "the ``script``. If it is not given: ``deterministic`` with a checkpoint, ``script`` without.",
    )
    reports: str | None = setting(
        None,
        "Table of reports to answer once, CSV or JSON.",
    )
    folder: str | None = setting(
        None,
        "Folder to watch for tables of reports; each is answered in ``advice.csv`` and ``advice.json`` "
        "there.",
    )
    port: int | None = setting(None, "Port of the service over HTTP; 0: a free one.", low=0, high=65535)
    fit: str | None = setting(
        None,
        "Journal, or table of reports with the column receive time: nothing is advised, and a trace law of "
        "its delays is written into the run folder as ``trace.csv``.",
    )
    fit_dt: float | None = setting(
        None,
        "Length of a step, with ``fit``: delays of the trace are whole steps, as the journal counts them; "
        "without it they are times, which a simulation rounds up to whole steps.",
        above=0.0,
        unit="s",
    )
    host: str = setting(
        "127.0.0.1",
        "Address that the service listens to: by default only programs of this machine reach it.",
    )
    token: str | None = setting(
        None,
        "Password of the service over HTTP; if not given, that of the environment variable "
        "``DAMIAN_TOKEN``, or one that is made and printed. No file of the run folder keeps it.",
    )
    uavs: list[str] = setting(
        [],
        "IDs of the UAVs of a table or a folder; those of the table, in their order, if not given.",
    )
    journal: str | None = setting(
        None,
        "Folder of the journals, which are restored from it at the start; in the run folder if not given.",
    )
    durable: bool = setting(
        False,
        "Make every line of a journal last even if the machine stops; it takes milliseconds.",
    )

    policies: ClassVar[tuple[str, ...]] = ("deterministic", "sampled", "script")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_token("token", self.token)

    def check_source(self) -> None:
        """Require exactly one source of reports.

        Raises:
            InputError: there is none, or more than one, or a journal is named that nothing would write.
        """
        given = [name for name in ("reports", "folder", "port", "fit") if getattr(self, name) is not None]
        if len(given) != 1:
            problem = f"{' and '.join(given)} are given" if given else "is missing"
            raise InputError(
                f"reports: {problem}: give one of reports=FILE, folder=FOLDER, port=NUMBER, fit=FILE"
            )
        if self.reports is not None or self.fit is not None:
            for name in ("journal", "durable"):
                problem = "is for a service or a folder, which alone have a journal: leave it out"
                checks.require(not getattr(self, name), name, getattr(self, name), problem)


def check_token(key: str, token: str | None) -> None:
    """Require a password that nobody guesses and every header can carry, if there is one."""
    good = token is None or (
        len(token) >= 16 and token.isascii() and token.isprintable() and " " not in token
    )
    checks.require(good, key, "it", "is not a password of at least 16 printable ASCII characters")


@dataclass
class TuneConfig(TrainConfig):
    """All settings of ``damian tune``: those of ``damian train``, and how to search."""

    search: dict[str, Any] = setting(
        {},
        "What to vary: settings of ``damian train``, each as ``{low: 1, high: 8}``, with ``log: true`` or "
        "``step``, or as ``{choices: [...]}``; conf/search has a file for each learner.",
    )
    trials: int = setting(30, "Number of trainings, pruned ones included.", low=1, high=1_000_000)
    processes: int = setting(
        1,
        "Number of trainings at the same time; each has one thread unless ``threads`` says otherwise.",
        low=1,
        high=1024,
    )
    prune: bool = setting(
        True,
        "Whether to stop trainings that are worse than the median.",
    )
    score: str = setting(
        "return",
        "The measure of the evaluation that is to be best (least, if it counts steps): return, "
        "success_rate or steps, of what truly happened; perceived_return, perceived_success_rate or "
        "steps, as the server perceived it.",
        choices=SCORES,
    )
    policy: str = setting(
        "sampled",
        "The policy that is evaluated: actions ``sampled`` from it, or the most likely ones "
        "(``deterministic``).",
        choices=("sampled", "deterministic"),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        succeeds = self.episode.success_share is not None or "success" not in self.score
        problem = "is the same for every policy: in this task nothing can be reached; choose return"
        checks.require(succeeds, "score", self.score, problem)
        for key in ("checkpoint", "resume"):
            problem = "is not for a search, which trains every policy from the beginning: leave it out"
            checks.require(getattr(self, key) is None, key, getattr(self, key), problem)

    @property
    def sign(self) -> int:
        """1 if the greatest score is the best, -1 if the least is."""
        return -1 if self.score in LESS_IS_BETTER else 1


@dataclass
class Arm(Settings):
    """One way to train policies for a task, or to fly those of another arm."""

    overrides: list[str] = setting(
        [],
        "Overrides of the settings of ``damian train``.",
    )
    delayed: bool = setting(
        True,
        "Whether the arm has delays. Exactly one arm has none: the reference, run once for each task.",
    )
    naive: bool = setting(
        False,
        "Whether the arm ignores the delay; recovery 0 is the score of the best such arm.",
    )
    policy_of: str | None = setting(
        None,
        "Arm whose policies this one flies, without any training of its own; None: this arm trains.",
    )
    untrained: bool = setting(
        False,
        "Whether the networks fly as they are before the first update, with their prior; nothing is trained.",
    )
    oracle: bool = setting(
        False,
        "Whether the script flies with ever more known on time (``damian oracle``), and nothing is trained.",
    )
    tasks: list[str] | None = setting(
        None,
        "Tasks of the experiment that the arm does; all of them if not given.",
    )
    regime: str = setting(
        "",
        "Information that the arm uses: R0: messages that have arrived; R1: the truth, for the critic; "
        "R2: no delay in training; R3: no delay at all. If it is not given, ``delayed`` and ``policy_of`` "
        "decide.",
        choices=("", "R0", "R1", "R2", "R3"),
    )


@dataclass
class HeldOut(Settings):
    """Changes of a task under which the policies that were trained without them are evaluated too."""

    overrides: list[str] = setting(
        [],
        "Overrides of ``damian train``, such as another region or number of UAVs.",
    )
    tasks: list[str] | None = setting(
        None,
        "Tasks of the experiment to change; all of them if not given. In a task whose features depend on "
        "the number of UAVs, a policy can fly only as many as it was trained with.",
    )


@dataclass
class Experiment(Settings):
    """Tasks, delays and arms to compare, as written in a file of conf/experiment."""

    section: ClassVar[str] = "experiment"

    tasks: dict[str, list[str]] = setting(
        {},
        "Overrides of ``damian train`` for each task.",
    )
    delays: dict[str, list[str]] = setting(
        {},
        "Overrides of ``damian train`` for each delay.",
    )
    arms: dict[str, Arm] = setting(
        {},
        "One of them, the reference, has ``delayed: false``.",
    )
    held_out: dict[str, HeldOut] = setting(
        {},
        "Changed tasks to evaluate all policies in; in the tables they are called TASK@NAME.",
    )
    first_seed: int = setting(0, "The seeds of every arm count from this one.", low=0)
    best: dict[str, float] = setting(
        {},
        "Best possible value of a measure: a dashed line in its learning curves.",
    )
    panels: dict[str, list[str]] = setting(
        {},
        "Arms of each column of figure.png, which then shows scores over delays, by its title.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for kind in ("tasks", "delays", "arms", "held_out"):
            for name in getattr(self, kind):
                good = re.fullmatch(r"[\w.-]+", name) and name not in TAKEN
                should = "cannot name a folder: use letters, digits, _ . - but not none, random or script"
                checks.require(bool(good), f"experiment.{kind}", name, should)
        for kind in ("tasks", "arms"):
            if not getattr(self, kind):
                raise InputError(
                    f"experiment.{kind}: it is missing or empty; an experiment needs at least one"
                )
        self._check_arms()
        for name, held_out in self.held_out.items():
            for task in held_out.tasks or ():
                checks.one_of(f"experiment.held_out.{name}.tasks", task, self.tasks)
        for name in self.best:
            checks.one_of("experiment.best", name, PERCEIVED_SCORES)
        for title, arms in self.panels.items():
            for arm in arms:
                checks.one_of(f"experiment.panels.{title}", arm, self.arms)

    def _check_arms(self) -> None:
        undelayed = [name for name, arm in self.arms.items() if not arm.delayed]
        should = "are not delayed: exactly one arm must have delayed=false"
        checks.require(len(undelayed) == 1, "experiment.arms", undelayed, should)
        never = [name for name, arm in self.arms.items() if arm.delayed and not self.delays]
        should = "run under no delay: name some under experiment.delays, or leave these arms out"
        checks.require(not never, "experiment.arms", never, should)
        for name, arm in self.arms.items():
            should = "trains nothing: it has no policy_of and no oracle, and delayed is not false"
            alone = arm.delayed and arm.policy_of is None and not arm.oracle
            checks.require(alone or not arm.untrained, f"experiment.arms.{name}", "untrained", should)
            if arm.oracle:
                should = "flies the script under delay: it has no policy_of, and delayed is not false"
                good = arm.policy_of is None and arm.delayed
                checks.require(good, f"experiment.arms.{name}", "oracle", should)
            source = self.arms.get(arm.policy_of or "", arm)
            for task in self.tasks if arm.tasks is None else arm.tasks:
                options = self.tasks if source.tasks is None else source.tasks
                checks.one_of(f"experiment.arms.{name}.tasks", task, options)


@dataclass
class CompareConfig(Settings):
    """All settings of ``damian compare``."""

    experiment: Experiment = MISSING
    seeds: int | None = setting(
        None,
        "Number of seeds, counted from ``experiment.first_seed``. If it is not given: 10, and with "
        "``report_only`` as many as are stored.",
        low=1,
        high=10_000,
    )
    processes: int = setting(
        1,
        "Number of runs at the same time; each has one thread unless ``overrides`` sets ``threads``.",
        low=1,
        high=1024,
    )
    launcher: str = setting(
        "local",
        "Where the runs are carried out: in processes of this machine (``local``), or as Slurm jobs "
        "(``slurm``). All machines must see the folder of the comparison (docs/scaling.md).",
        choices=LAUNCHERS,
    )
    slurm: Any = setting(
        None,
        "Parameters of submitit's executor with ``launcher=slurm``, such as ``{slurm_partition: cpu, "
        "timeout_min: 600}``; ``{cluster: local}`` starts the jobs on this machine.",
    )
    tasks: list[str] | None = setting(
        None,
        "Names of the tasks to run; all of the experiment's if not given.",
    )
    delays: list[str] | None = setting(
        None,
        "Names of the delays to run; all of the experiment's if not given.",
    )
    arms: list[str] | None = setting(
        None,
        "Names of the arms to run; all of the experiment's if not given.",
    )
    overrides: list[str] = setting(
        [],
        "Further overrides of ``damian train`` for every run.",
    )
    score: str = setting(
        "return",
        "The measure J that J_norm and recovery are computed from: return, success_rate or steps, of what "
        "truly happened; perceived_return, perceived_success_rate or steps, as the server perceived it.",
        choices=SCORES,
    )
    policy: str = setting(
        "sampled",
        "The evaluation that J comes from: actions ``sampled`` from the policy, or the most likely ones "
        "(``deterministic``).",
        choices=("sampled", "deterministic"),
    )
    report_only: bool = setting(
        False,
        "Train and fly nothing; write tables and figures from the finished or the stored results.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        problem = "means nothing without launcher=slurm"
        checks.require(self.slurm is None or self.launcher == "slurm", "slurm", self.slurm, problem)
        mapping = self.slurm is None or isinstance(self.slurm, dict)
        checks.require(mapping, "slurm", self.slurm, "is no mapping such as {slurm_partition: cpu}")
        for word in self.overrides:
            ours = word.lstrip("+~").partition("=")[0].partition(".")[0] in SET_BY_COMPARISON
            problem = "cannot be the same for every run: the comparison sets it; leave it out"
            checks.require(not ours, "overrides", word, problem)
        for kind in ("tasks", "delays", "arms"):
            none = getattr(self, kind) == [] and kind != "delays"
            checks.require(not none, kind, [], "names none: leave it out, for all of them")
            for name in getattr(self, kind) or ():
                checks.one_of(kind, name, getattr(self.experiment, kind))
        for name, arm in self.chosen("arms").items():
            if arm.policy_of is not None:
                sources = [
                    n
                    for n, a in self.chosen("arms").items()
                    if a.policy_of is None and not (a.oracle or a.untrained)
                ]
                checks.one_of(f"experiment.arms.{name}.policy_of", arm.policy_of, sources)

    def chosen(self, kind: str) -> dict[str, Any]:
        """The experiment's tasks, delays or arms (``kind``) that are asked for, by name."""
        every, only = getattr(self.experiment, kind), getattr(self, kind)
        return {name: every[name] for name in every if only is None or name in only}

    @property
    def every_seed(self) -> range:
        """The seeds that are asked for."""
        n_seeds = SEEDS if self.seeds is None else self.seeds
        return range(self.experiment.first_seed, self.experiment.first_seed + n_seeds)
