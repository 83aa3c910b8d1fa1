"""Arms beside each other over tasks, delays and seeds: means, J_norm and recovery, with their intervals."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from damian.evaluation.statistics import (
    LEAST_GAP,
    Floats,
    bootstrap,
    interquartile_mean,
    normalised,
    recovery,
)

SAMPLED, MODE, RANDOM, GREEDY = "trained, sampled", "trained, mode", "random", "greedy"
SCRIPTED = (RANDOM, GREEDY)
"""Fly the same episodes beside each arm, and learn nothing."""
NOT_LATE = "none"
"""The delay of what is not delayed."""
TRUE = ("true_return", "true_success_rate", "true_steps")
SEEN = ("episode_return", "success_rate", "steps")
MEASURES = (*TRUE, *SEEN, "age", "late", "lost")
SCORES = (*TRUE, *SEEN)
LESS_IS_BETTER = ("true_steps", "steps")

Row = Mapping[str, Any]
"""task, delay, arm, regime, seed, policy, and a number for each measure."""


@dataclass
class Arm:
    """One way to learn, or to fly, a task."""

    overrides: list[str] = field(default_factory=list)
    """Of ``recipes/train.py``."""
    delayed: bool = True
    """One arm is not: the reference, run once for each task."""
    naive: bool = False
    """Does not know of the delay; the stronger of such arms is what recovery counts from."""
    policy_of: str | None = None
    """Trains nothing: flies the policies of that arm."""
    regime: str = "R0"
    """What it may know: R0, R1, R2 or R3."""


class Estimate(NamedTuple):
    """A number and its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        if np.isnan(self.value):
            return "-"
        return f"{_short(self.value)} [{_short(self.low)}, {_short(self.high)}]"


UNKNOWN = Estimate(np.nan, np.nan, np.nan)


def _short(number: float) -> str:
    return f"{number:.3f}" if abs(number) < 10 else f"{number:.1f}"


def _estimates(statistic: Any, scores: Floats) -> list[Estimate]:
    """Of a statistic that leaves one dimension of ``scores``, [strata, ..., seeds] to [K]."""
    low, high = bootstrap(statistic, scores)
    ends = (np.ravel(statistic(scores)), np.ravel(low), np.ravel(high))
    return [Estimate(*map(float, numbers)) for numbers in zip(*ends, strict=True)]


@dataclass(frozen=True)
class Comparison:
    """All rows of all runs, and what they mean."""

    rows: Sequence[Row]
    arms: Mapping[str, Arm]
    score: str = "true_return"
    policy: str = SAMPLED
    """Whose score is compared."""

    @cached_property
    def lines(self) -> list["Line"]:
        """The table: bootstrapped once, whoever reads it."""
        return list(_lines(self))

    @property
    def undelayed(self) -> str:
        """The arm without delay."""
        return next(name for name, arm in self.arms.items() if not arm.delayed)

    def tasks(self) -> list[str]:
        """Those with a finished run."""
        return list(dict.fromkeys(row["task"] for row in self.rows))

    def delays(self, task: str) -> list[str]:
        """Those with a finished run."""
        found = (row["delay"] for row in self.rows if row["task"] == task)
        return [name for name in dict.fromkeys(found) if name != NOT_LATE]

    def present(self, task: str, delay: str) -> list[str]:
        """Arms with a finished run."""
        found = {row["arm"] for row in self.rows if (row["task"], row["delay"]) == (task, delay)}
        return [name for name in self.arms if name in found]

    def values(self, task: str, delay: str, arm: str, policy: str, measure: str) -> dict[int, float]:
        """One number for each seed."""
        place = (task, delay, arm, policy)
        keys = ("task", "delay", "arm", "policy")
        return {r["seed"]: r[measure] for r in self.rows if tuple(r[key] for key in keys) == place}

    def scores(self, task: str, delay: str) -> dict[str, dict[int, float]]:
        """By arm, more is better: undelayed and the random policy (both without delay) first."""
        sign = -1 if self.score in LESS_IS_BETTER else 1
        wanted = {self.undelayed: (NOT_LATE, self.undelayed, self.policy)}
        wanted[RANDOM] = (NOT_LATE, self.undelayed, RANDOM)
        wanted |= {arm: (delay, arm, self.policy) for arm in self.present(task, delay)}
        found = {name: self.values(task, *place, self.score) for name, place in wanted.items()}
        return {name: {seed: sign * x for seed, x in runs.items()} for name, runs in found.items()}

    def compared(self, task: str, delay: str) -> dict[str, tuple[Estimate, Estimate]]:
        """J_norm and recovery of each delayed arm, over the seeds that all arms have finished."""
        scores = self.scores(task, delay)
        seeds = sorted(set.intersection(*map(set, scores.values())))
        names = list(scores)[2:]
        if not seeds or not names:
            return {}
        array = np.array([[[runs[seed] for seed in seeds] for runs in scores.values()]])
        norms = _estimates(_norms, array)
        naive = [place for place, name in enumerate(names, 2) if self.arms[name].naive]
        gains = _recoveries(array, naive) if naive else [UNKNOWN] * len(names)
        return {
            name: (norm, UNKNOWN if self.arms[name].naive else gain)
            for name, norm, gain in zip(names, norms, gains, strict=True)
        }

    def overall(self) -> dict[str, Estimate]:
        """Interquartile mean of the J_norm of all runs, over tasks, delays and seeds.

        Of the arms, delays and seeds that every task has; none unless there are several places to average.
        Resampled within each task, whose delays share the undelayed arm.
        """
        places = {task: self.delays(task) for task in self.tasks()}
        delays = [d for d in next(iter(places.values()), []) if all(d in ds for ds in places.values())]
        cells = [[self.scores(task, delay) for delay in delays] for task in places]
        flat = [cell for row in cells for cell in row]
        if len(flat) < 2:
            return {}
        names = [name for name in flat[0] if all(name in cell for cell in flat)]
        seeds = sorted(set.intersection(*(set(cell[name]) for cell in flat for name in names)))
        if not seeds or len(names) < 3:
            return {}
        array = [[[[cell[n][s] for s in seeds] for n in names] for cell in row] for row in cells]
        return dict(zip(names[2:], _estimates(_interquartile_norms, np.array(array)), strict=True))


def _norms(scores: Floats) -> Floats:
    """J_norm of means, [*, 1, arms, seeds] to [*, arms - 2]; the first two are undelayed and random."""
    means = scores.mean(-1)[..., 0, :]
    return normalised(means[..., 2:], means[..., :1], means[..., 1:2])


def _interquartile_norms(scores: Floats) -> Floats:
    """[*, tasks, delays, arms, seeds] to [*, arms - 2]."""
    means = scores.mean(-1, keepdims=True)
    norms = normalised(scores[..., 2:, :], means[..., :1, :], means[..., 1:2, :])
    by_arm = np.moveaxis(norms, -2, -4)
    return interquartile_mean(by_arm.reshape(*by_arm.shape[:-3], -1))


def _recoveries(scores: Floats, naive: list[int]) -> list[Estimate]:
    """Of all arms but the first two, [1, arms, seeds]; ``naive``: places of the naive ones."""

    def statistic(scores: Floats, least: float = 0.0) -> Floats:
        means = scores.mean(-1)[..., 0, :]
        strongest = means[..., naive].max(-1, keepdims=True)
        return recovery(means[..., 2:], strongest, means[..., :1], means[..., 1:2], least)

    shown = ~np.isnan(statistic(scores, LEAST_GAP))
    estimates = _estimates(statistic, scores)
    return [each if show else UNKNOWN for each, show in zip(estimates, shown, strict=True)]


@dataclass(frozen=True)
class Line:
    """Of a table: one arm, flown by one policy, over its seeds."""

    task: str
    delay: str
    arm: str
    regime: str
    policy: str
    seeds: list[int]
    measures: dict[str, Estimate]
    j_norm: Estimate = UNKNOWN
    recovery: Estimate = UNKNOWN

    def cells(self) -> dict[str, Any]:
        """The columns of ``table.csv``; what is not known is empty."""
        numbers = {**self.measures, "J_norm": self.j_norm, "recovery": self.recovery}
        cells: dict[str, Any] = {k: getattr(self, k) for k in ("task", "delay", "arm", "regime", "policy")}
        cells["seeds"] = len(self.seeds)
        for name, number in numbers.items():
            known = [float("nan")] * 3 if np.isnan(number.value) else number
            for end, value in zip(("", "_low", "_high"), known, strict=True):
                cells[name + end] = "" if np.isnan(value) else value
        return cells


def _lines(comparison: Comparison) -> Iterator[Line]:
    """Every arm and policy, task by task and delay by delay; the undelayed arm first."""
    for task in comparison.tasks():
        for delay in (NOT_LATE, *comparison.delays(task)):
            arms = comparison.present(task, delay)
            compared = {} if delay == NOT_LATE else comparison.compared(task, delay)
            for arm in arms:
                for policy in (SAMPLED, MODE):
                    line = _line(comparison, task, delay, arm, policy)
                    told = compared.get(arm) if policy == comparison.policy else None
                    yield replace(line, j_norm=told[0], recovery=told[1]) if told else line
            for arm in arms[:1]:
                for policy in SCRIPTED:
                    if comparison.values(task, delay, arm, policy, comparison.score):  # older runs lack some
                        yield replace(_line(comparison, task, delay, arm, policy), arm=policy, regime="")


def _line(comparison: Comparison, task: str, delay: str, arm: str, policy: str) -> Line:
    found = {name: comparison.values(task, delay, arm, policy, name) for name in MEASURES}
    means = {
        name: _estimates(lambda scores: scores.mean(-1), np.array([list(runs.values())]))[0]
        for name, runs in found.items()
    }
    regime = comparison.arms[arm].regime
    return Line(task, delay, arm, regime, policy, sorted(found["age"]), means)
