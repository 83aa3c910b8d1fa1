"""Experiments: tasks, delays and arms to compare."""

import re
from dataclasses import dataclass, field

from damian.common import checks
from damian.common.errors import InputError
from damian.compare.comparison import NOT_LATE, SCRIPTED, Arm
from damian.compare.figures import LABELS


@dataclass
class HeldOut:
    """Changes of a task under which the policies that were trained without them are evaluated too."""

    overrides: list[str] = field(default_factory=list)
    """Overrides of ``damian train``, such as another region or number of UAVs."""
    tasks: list[str] | None = None
    """Tasks of the experiment to change; all of them if not given. In a task whose features depend on the
    number of UAVs, a policy can fly only as many as it was trained with."""


@dataclass
class Experiment:
    """Tasks, delays and arms to compare, as written in a file of conf/experiment."""

    tasks: dict[str, list[str]] = field(default_factory=dict)
    """Overrides of ``damian train`` for each task."""
    delays: dict[str, list[str]] = field(default_factory=dict)
    """Overrides of ``damian train`` for each delay."""
    arms: dict[str, Arm] = field(default_factory=dict)
    """One of them, the reference, has ``delayed: false``."""
    held_out: dict[str, HeldOut] = field(default_factory=dict)
    """Changed tasks to evaluate all policies in; in the tables they are called TASK@NAME."""
    first_seed: int = 0
    """The seeds of every arm count from this one."""
    best: dict[str, float] = field(default_factory=dict)
    """Best possible value of a measure: a dashed line in its learning curves."""
    panels: dict[str, list[str]] = field(default_factory=dict)
    """Arms of each column of figure.png, which then shows scores over delays, by its title."""

    def __post_init__(self) -> None:
        for kind in ("tasks", "delays", "arms", "held_out"):
            for name in getattr(self, kind):
                good = re.fullmatch(r"[\w.-]+", name) and name not in (NOT_LATE, *SCRIPTED)
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
            checks.one_of("experiment.best", name, LABELS)
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
            if arm.regime:
                checks.one_of(f"experiment.arms.{name}.regime", arm.regime, ("R0", "R1", "R2", "R3"))
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
