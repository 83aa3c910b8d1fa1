"""Settings of a comparison: tasks, delays, the methods that are compared, and by which score."""

import re
from dataclasses import dataclass
from typing import Any

from damian.common import checks
from damian.common.fields import Settings, setting
from damian.runs.measures import check_score

MISSING: Any = "???"
"""Hydra's and OmegaConf's mark of a value that must be given."""
STORED = ("sampled", "deterministic")
"""Policies of a checkpoint: its actions are drawn, or the most likely ones."""
SEEDS = 10
"""Seeds of a comparison, if their number is not given; with fewer, a report is marked as
developing."""
EPISODES = 100
"""With fewer episodes in an evaluation a report is marked as developing."""
SET_BY_COMPARISON = ("seed", "resume", "checkpoint", "logger", "hydra")
"""Keys that a comparison sets for each of its runs."""


@dataclass
class Method(Settings):
    """One way to train policies for a task, or to fly those of another method."""

    overrides: list[str] = setting([], "Overrides of the settings of ``damian train``.")
    delayed: bool = setting(
        True, "Whether it has delays; exactly one method, the reference, has none."
    )
    naive: bool = setting(
        False, "Whether it ignores the delay; the best such method has recovery 0."
    )
    policy_of: str | None = setting(
        None, "Method whose policies it flies, without any training of its own."
    )
    starts_from: str | None = setting(
        None, "Method from whose policies, of the same seed, training starts."
    )
    teacher: str | None = setting(
        None, "Method whose policies its learner imitates: ``learner.teacher``."
    )
    flies: str | None = setting(
        None,
        "What flies in the place of a trained policy: the network before the first update, the "
        "script, or the planner.",
        choices=("untrained", "script", "planner"),
    )
    tasks: list[str] | None = setting(None, "Tasks that the method does; all of them if not given.")
    delays: list[str] | None = setting(
        None, "Delays under which the method runs; all of them if not given."
    )
    simulator: bool | None = setting(
        None,
        "Whether its training uses what only a simulator knows; if not given, whether ``source`` "
        "does.",
    )

    @property
    def source(self) -> str | None:
        """Method whose policies it flies, starts from, or imitates."""
        return self.policy_of or self.starts_from or self.teacher

    @property
    def has_model(self) -> bool:
        """Whether a model of the world predicts late messages while it flies."""
        flown_forward = any(word.startswith("observation.forward=") for word in self.overrides)
        return flown_forward or self.flies == "planner"


@dataclass
class HeldOut(Settings):
    """Changes of a task under which the policies that were trained without them are evaluated
    too."""

    overrides: list[str] = setting([], "Overrides of ``damian train``, such as another region.")
    tasks: list[str] | None = setting(None, "Tasks to change; all of them if not given.")
    delays: list[str] | None = setting(None, "Delays of the training; all of them if not given.")
    methods: list[str] | None = setting(
        None, "Methods whose policies are flown; all of them if not given."
    )


@dataclass
class Experiment(Settings):
    """Tasks, delays and methods to compare, as written in a file of conf/experiment."""

    section = "experiment"

    tasks: dict[str, list[str]] = setting({}, "Overrides of ``damian train`` for each task.")
    delays: dict[str, list[str]] = setting({}, "Overrides of ``damian train`` for each delay.")
    methods: dict[str, Method] = setting(
        {}, "Ways to train or fly; one of them has ``delayed: false``."
    )
    held_out: dict[str, HeldOut] = setting(
        {}, "Changed tasks, TASK@NAME, to evaluate all policies in."
    )
    first_seed: int = setting(0, "The seeds of every method count from this one.", low=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        for kind in ("tasks", "delays", "methods", "held_out"):
            for name in getattr(self, kind):
                good = re.fullmatch(r"[\w.+-]+", name) and name not in ("none", "random", "script")
                checks.require(
                    bool(good),
                    f"experiment.{kind}",
                    name,
                    "cannot name a folder: use letters, digits, _ . + - but not none, random or "
                    "script",
                )
        for kind in ("tasks", "methods"):
            self.refuse(
                not getattr(self, kind), kind, "is missing or empty; an experiment needs one"
            )
        self._check_methods()
        for name, held_out in self.held_out.items():
            for kind in ("tasks", "delays", "methods"):
                for each in getattr(held_out, kind) or ():
                    checks.one_of(f"experiment.held_out.{name}.{kind}", each, getattr(self, kind))

    def _check_methods(self) -> None:
        undelayed = [name for name, method in self.methods.items() if not method.delayed]
        checks.require(
            len(undelayed) == 1,
            "experiment.methods",
            undelayed,
            "are not delayed: exactly one method must have delayed=false",
        )
        never = not self.delays and len(self.methods) > len(undelayed)
        self.refuse(never, "delays", "is empty, but there are delayed methods")
        for name, method in self.methods.items():
            key = f"experiment.methods.{name}"
            good = method.delayed and method.policy_of is None
            checks.require(
                good or not method.flies,
                f"{key}.flies",
                method.flies,
                "goes with neither policy_of nor delayed=false",
            )
            source = self.methods.get(method.source or "", method)
            for kind in ("tasks", "delays"):
                every = getattr(self, kind)
                does, options = (getattr(each, kind) for each in (method, source))
                for each in every if does is None else does:
                    checks.one_of(f"{key}.{kind}", each, every if options is None else options)


@dataclass
class CompareConfig(Settings):
    """All settings of ``damian compare``."""

    experiment: Experiment = MISSING
    seeds: int | None = setting(
        None,
        "Number of seeds; if not given 10, or with ``report_only`` all stored ones.",
        low=1,
        high=10_000,
    )
    processes: int = setting(1, "Runs at the same time, of one thread each.", low=1, high=1024)
    tasks: list[str] | None = setting(None, "Tasks to run; all of the experiment's if not given.")
    delays: list[str] | None = setting(None, "Delays to run; all of the experiment's if not given.")
    methods: list[str] | None = setting(
        None, "Methods to run; all of the experiment's if not given."
    )
    overrides: list[str] = setting([], "Further overrides of ``damian train`` for every run.")
    score: str = setting(
        "return",
        "Metric that counts: return, success_rate, steps, perceived_return, ..., or your own.",
    )
    report_only: bool = setting(False, "Run nothing; write tables and figures from stored results.")
    keep: bool = setting(
        False, "Keep the results of runs whose folders are gone, and run only the others."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_score(self.score)
        for word in self.overrides:
            ours = word.lstrip("+~").partition("=")[0].partition(".")[0] in SET_BY_COMPARISON
            checks.require(
                not ours,
                "overrides",
                word,
                "cannot be the same for every run: the comparison sets it; leave it out",
            )
        for kind in ("tasks", "delays", "methods"):
            for name in getattr(self, kind) or ():
                checks.one_of(kind, name, getattr(self.experiment, kind))
        methods = self.chosen("methods")
        trained = [n for n, a in methods.items() if not (a.policy_of or a.flies)]
        for name, method in methods.items():
            for kind in ("policy_of", "starts_from", "teacher"):
                if getattr(method, kind) is not None:
                    checks.one_of(
                        f"experiment.methods.{name}.{kind}", getattr(method, kind), trained
                    )

    def chosen(self, kind: str) -> dict[str, Any]:
        """The experiment's tasks, delays or methods (``kind``) that are asked for, by name."""
        every = getattr(self.experiment, kind)
        only = getattr(self, kind)
        return {name: every[name] for name in every if only is None or name in only}

    @property
    def every_seed(self) -> range:
        """The seeds that are asked for."""
        n_seeds = SEEDS if self.seeds is None else self.seeds
        return range(self.experiment.first_seed, self.experiment.first_seed + n_seeds)
