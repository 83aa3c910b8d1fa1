"""Comparison of arms over tasks, delays and seeds: means, J_norm and recovery, with 95 % intervals."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from damian.compare.config import LESS_IS_BETTER, Arm
from damian.compare.statistics import (
    LEAST_GAP,
    Floats,
    bootstrap,
    improvement_interval,
    interquartile_mean,
    normalised,
    probability_of_improvement,
    recovery,
)
from damian.runs.run_folder import DETERMINISTIC, RANDOM, SCRIPT, TRAINED, UNTRAINED

TRAINED_DETERMINISTIC, UNTRAINED_DETERMINISTIC = TRAINED + DETERMINISTIC, UNTRAINED + DETERMINISTIC
SCRIPTED = (RANDOM, SCRIPT)
"""Policies that fly the same episodes beside each arm, and learn nothing."""
OF_ARM = (TRAINED, TRAINED_DETERMINISTIC, UNTRAINED, UNTRAINED_DETERMINISTIC)
"""Policies of an arm: its network after the training and before the first update."""
UNTRAINED_OF: dict[str, str] = dict(zip(OF_ARM[:2], OF_ARM[2:], strict=True))
"""The policy of an untrained arm that stands for the trained one of other arms."""
HELD_OUT_MARK = "@"
"""Stands between a task and a change of it under which the task's policies fly untrained."""
NOT_LATE = "none"
"""Name that stands for the delay of an undelayed arm."""


@dataclass(frozen=True)
class Column:
    """A column of numbers in the tables of a comparison."""

    name: str
    """Its name in files; that of the measure."""
    head: str
    """Its heading in Markdown."""
    bounds: tuple[float, float] = (-np.inf, np.inf)
    """Smallest and largest possible value."""


_SHARE, _TIME = (0.0, 1.0), (0.0, np.inf)
MEASURED = (
    Column("return", "return"),
    Column("success_rate", "success", _SHARE),
    Column("steps", "steps", _TIME),
    Column("perceived_return", "perceived return"),
    Column("perceived_success_rate", "perceived success", _SHARE),
    Column("perceived_steps", "perceived steps", _TIME),
    Column("age", "age", _TIME),
    Column("late", "late", _SHARE),
    Column("lost", "lost", _SHARE),
    Column("backupdated", "back-updated", _SHARE),
)
"""Means over seeds. The first ones are of an ``Evaluation``: from messages without delay and, ``perceived_``,
as the server perceived them."""
COMPARED = (
    Column("J_norm", "J_norm"),
    Column("recovery", "recovery"),
    Column("improvement", "P > naive"),
)
"""What ``Comparison.compared`` finds of an arm: J_norm is 0 for the random policy, 1 for the undelayed arm;
recovery is 0 for the strongest naive arm of the same track and 1 for the undelayed one; improvement: the
probability that a run beats one of that naive arm."""
MEASURES = tuple(column.name for column in MEASURED)
BOUNDS = {column.name: column.bounds for column in MEASURED}

Row = Mapping[str, Any]
"""Evaluation of one policy: task, delay, arm, regime, seed, policy, a number for each measure, and of its run
the ``frames`` (environment steps in training) and ``seconds``. Unknown or meaningless numbers are nan."""


def regime(arms: Mapping[str, Arm], name: str) -> str:
    """The regime of an arm: its own, or R3 without delay, R2 if it needs a policy without, or else R0."""
    arm = arms[name]
    if arm.regime:
        return arm.regime
    if not arm.delayed:
        return "R3"
    if arm.source is None:
        return "R0"
    return "R2" if not arms[arm.source].delayed else regime(arms, arm.source)


def track(arms: Mapping[str, Arm], name: str) -> str:
    """The track of an arm; no recovery mixes arms that learn from late data and arms that had a simulator."""
    return "late data only" if regime(arms, name) == "R0" else "simulator allowed"


class Estimate(NamedTuple):
    """A value and the ends of its 95 % interval, which are nan for fewer than three seeds."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        if np.isnan(self.value):
            return "-"
        if np.isnan(self.low):
            return _short(self.value)
        return f"{_short(self.value)} [{_short(self.low)}, {_short(self.high)}]"


UNKNOWN = Estimate(np.nan, np.nan, np.nan)
"""Stands for an estimate that cannot be made, or has no meaning."""


@dataclass(frozen=True)
class Compared:
    """An arm compared with the undelayed one, the random policy and the naive arms, under the same delay."""

    seeds: list[int] = field(default_factory=list)
    """Seeds that all of these have finished; empty if there is none, and nothing is compared."""
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    """By names of ``COMPARED``; what cannot be estimated is missing."""

    def __getitem__(self, name: str) -> Estimate:
        return self.estimates.get(name, UNKNOWN)


def _short(number: float) -> str:
    return f"{number:.3f}" if abs(number) < 10 else f"{number:.1f}"


def _estimates(
    statistic: Any, scores: Floats, bounds: tuple[float, float] = (-np.inf, np.inf)
) -> list[Estimate]:
    """Estimates of a statistic that maps ``scores`` [strata, ..., seeds] to [K], within ``bounds``."""
    low, high = bootstrap(statistic, scores, bounds=bounds)
    ends = (np.ravel(statistic(scores)), np.ravel(low), np.ravel(high))
    return [Estimate(*map(float, numbers)) for numbers in zip(*ends, strict=True)]


@dataclass(frozen=True)
class Comparison:
    """The rows of all runs, and the statistics that follow from them."""

    rows: Sequence[Row]
    arms: Mapping[str, Arm]
    score: str = "return"
    """Measure that is the J of J_norm and recovery."""
    policy: str = TRAINED
    """Policy with which the arms are compared, ``TRAINED`` or ``TRAINED_DETERMINISTIC``."""

    @cached_property
    def lines(self) -> list["Line"]:
        """Lines of the table; cached, because the bootstrap takes time."""
        return list(_lines(self))

    @property
    def undelayed(self) -> str:
        """Name of the arm without delay; empty if there is none, and then nothing is compared with it."""
        return next((name for name, arm in self.arms.items() if not arm.delayed), "")

    def tasks(self) -> list[str]:
        """Tasks with a finished run."""
        return list(dict.fromkeys(row["task"] for row in self.rows))

    def delays(self, task: str) -> list[str]:
        """Delays of a task with a finished run, without ``NOT_LATE``."""
        found = (row["delay"] for row in self.rows if row["task"] == task)
        return [name for name in dict.fromkeys(found) if name != NOT_LATE]

    def runs(self) -> list[Row]:
        """The first row of each run."""
        keys = ("task", "delay", "arm", "seed")
        return list({tuple(row[key] for key in keys): row for row in reversed(self.rows)}.values())[::-1]

    def present(self, task: str, delay: str) -> list[str]:
        """Arms with a policy of their own that have a finished run of a task under a delay."""
        found = {row["arm"] for row in self.rows if (row["task"], row["delay"]) == (task, delay)}
        return [name for name in self.arms if name in found]

    def values(self, task: str, delay: str, arm: str, policy: str, measure: str) -> dict[int, float]:
        """Values of a measure by seed; an untrained arm has none but those of its untrained network."""
        if arm in self.arms and self.arms[arm].untrained:
            policy = UNTRAINED_OF.get(policy, policy)
        return {row["seed"]: row[measure] for row in self._rows_of.get((task, delay, arm, policy), ())}

    @cached_property
    def _rows_of(self) -> dict[tuple[str, ...], list[Row]]:
        """Rows by task, delay, arm and policy."""
        found: dict[tuple[str, ...], list[Row]] = {}
        for row in self.rows:
            found.setdefault((row["task"], row["delay"], row["arm"], row["policy"]), []).append(row)
        return found

    def scores(self, task: str, delay: str) -> dict[str, dict[int, float]]:
        """Scores by arm and seed, higher ones better; first come undelayed and random, without delay."""
        sign = -1 if self.score in LESS_IS_BETTER else 1
        sources = {self.undelayed: (NOT_LATE, self.undelayed, self.policy)}
        sources[RANDOM] = (NOT_LATE, self.undelayed, RANDOM)
        sources |= {arm: (delay, arm, self.policy) for arm in self.present(task, delay)}
        found = {name: self.values(task, *source, self.score) for name, source in sources.items()}
        return {name: {seed: sign * x for seed, x in runs.items()} for name, runs in found.items()}

    def compared(self, task: str, delay: str) -> dict[str, Compared]:
        """Each delayed arm, over the seeds that it and all arms that it is compared with have finished."""
        scores = self.scores(task, delay)
        found = {name: self._compared(scores, name) for name in list(scores)[2:]}
        return {name: result for name, result in found.items() if result.seeds}

    def _compared(self, scores: Mapping[str, Mapping[int, float]], arm: str) -> Compared:
        others = [name for name in list(scores)[2:] if track(self.arms, name) == track(self.arms, arm)]
        naive = [name for name in others if self.arms[name].naive]
        names = [*list(scores)[:2], *(name for name in naive if name != arm), arm]
        seeds, array = _paired([scores[name] for name in names])
        if not seeds:
            return Compared()
        found = {"J_norm": _estimates(_norms, array)[0]}
        if naive and arm not in naive:
            probability = float(_improvement(array))
            found["improvement"] = Estimate(probability, *improvement_interval(probability, len(seeds)))
            found["recovery"] = _recovery(array)
        return Compared(seeds, found)

    def overall(self) -> dict[str, tuple[int, Estimate]]:
        """Number of seeds and interquartile mean of J_norm by delayed arm, over all tasks and delays.

        Held-out tasks do not count. Of the others, only the arms and delays that every one has do, and of
        each arm the seeds that it and the undelayed arm have everywhere; there must be two combinations of
        task and delay. Seeds are resampled within each task, because its delays share the undelayed arm.
        """
        by_task = {task: self.delays(task) for task in self.tasks() if HELD_OUT_MARK not in task}
        delays = [d for d in next(iter(by_task.values()), []) if all(d in ds for ds in by_task.values())]
        cells = [[self.scores(task, delay) for delay in delays] for task in by_task]
        flat = [cell for row in cells for cell in row]
        if len(flat) < 2:
            return {}
        found = {}
        for name in list(flat[0])[2:]:
            if all(name in cell for cell in flat):
                names = [*list(flat[0])[:2], name]
                seeds, array = _paired([cell[name] for cell in flat for name in names])
                if seeds:
                    by_cell = array.reshape(len(cells), len(delays), len(names), len(seeds))
                    found[name] = (len(seeds), *_estimates(_interquartile_norms, by_cell))
        return found


def mean_over_seeds(values: Sequence[float], measure: str) -> Estimate:
    """Mean of the values of a measure by seed."""
    return _estimates(lambda drawn: drawn.mean(-1), np.array([values]), BOUNDS[measure])[0]


def _paired(runs: Sequence[Mapping[int, float]]) -> tuple[list[int], Floats]:
    """Seeds that all runs have, and their scores, [1, runs, seeds]."""
    seeds = sorted(set.intersection(*map(set, runs)))
    return seeds, np.array([[[scores[seed] for seed in seeds] for scores in runs]])


def _norms(scores: Floats) -> Floats:
    """J_norm of the last arm's mean score, [*, 1, arms, seeds] to [*]; first come undelayed and random."""
    means = scores.mean(-1)[..., 0, :]
    return normalised(means[..., -1], means[..., 0], means[..., 1])


def _improvement(scores: Floats) -> Floats:
    """Probability that the last arm beats the strongest of ``scores[..., 2:-1, :]``, the naive ones."""
    naive = scores[..., 0, 2:-1, :]
    strongest = np.expand_dims(naive.mean(-1).argmax(-1), (-1, -2))
    other = np.take_along_axis(naive, strongest, -2)[..., 0, :]
    return probability_of_improvement(scores[..., 0, -1, :], other)


def _interquartile_norms(scores: Floats) -> Floats:
    """Interquartile means of J_norm, [*, tasks, delays, arms, seeds] to [*, arms - 2]."""
    means = scores.mean(-1, keepdims=True)
    norms = normalised(scores[..., 2:, :], means[..., :1, :], means[..., 1:2, :])
    by_arm = np.moveaxis(norms, -2, -4)
    return interquartile_mean(by_arm.reshape(*by_arm.shape[:-3], -1))


def _recovery(scores: Floats) -> Estimate:
    """Recovery of the last arm, [1, arms, seeds]; first come undelayed and random, then the naive arms."""

    def statistic(scores: Floats, least: float = 0.0) -> Floats:
        means = scores.mean(-1)[..., 0, :]
        return recovery(means[..., -1], means[..., 2:-1].max(-1), means[..., 0], means[..., 1], least)

    return UNKNOWN if np.isnan(statistic(scores, LEAST_GAP)) else _estimates(statistic, scores)[0]


@dataclass(frozen=True)
class Line:
    """Line of the table: one policy of one arm, over its seeds."""

    task: str
    delay: str
    arm: str
    regime: str
    policy: str
    seeds: list[int]
    measures: dict[str, Estimate]
    compared: Compared = field(default_factory=Compared)

    def cells(self) -> dict[str, Any]:
        """Columns of ``table.csv`` by name; unknown numbers are empty."""
        cells: dict[str, Any] = {k: getattr(self, k) for k in ("task", "delay", "arm", "regime", "policy")}
        cells |= {"seeds": len(self.seeds), "compared_seeds": len(self.compared.seeds)}
        found = {**self.measures, **{column.name: self.compared[column.name] for column in COMPARED}}
        for name, estimate in found.items():
            parts = UNKNOWN if np.isnan(estimate.value) else estimate
            for suffix, value in zip(("", "_low", "_high"), parts, strict=True):
                cells[name + suffix] = "" if np.isnan(value) else value
        return cells


def _lines(comparison: Comparison) -> Iterator[Line]:
    """Lines of every arm and policy, task by task and delay by delay; the undelayed arm comes first."""
    for task in comparison.tasks():
        for delay in (NOT_LATE, *comparison.delays(task)):
            arms = comparison.present(task, delay)
            compared = {} if delay == NOT_LATE else comparison.compared(task, delay)
            for arm in arms:
                for policy in OF_ARM[2:] if comparison.arms[arm].untrained else OF_ARM:
                    # An arm that flies the policies of another one has no untrained network.
                    if comparison.values(task, delay, arm, policy, comparison.score):
                        line = _line(comparison, task, delay, arm, policy)
                        untrained = UNTRAINED_OF if comparison.arms[arm].untrained else {}
                        best = policy == untrained.get(comparison.policy, comparison.policy)
                        found = compared.get(arm) if best else None
                        yield replace(line, compared=found) if found else line
            for arm in arms[:1]:
                for policy in SCRIPTED:
                    # The script does not fly in every region.
                    if comparison.values(task, delay, arm, policy, comparison.score):
                        yield replace(_line(comparison, task, delay, arm, policy), arm=policy, regime="")


def _line(comparison: Comparison, task: str, delay: str, arm: str, policy: str) -> Line:
    found = {name: comparison.values(task, delay, arm, policy, name) for name in MEASURES}
    means = {name: mean_over_seeds(list(runs.values()), name) for name, runs in found.items()}
    information = regime(comparison.arms, arm)
    return Line(task, delay, arm, information, policy, sorted(found["age"]), means)
