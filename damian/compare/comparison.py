"""Comparison of arms over tasks, delays and seeds: means, J_norm and recovery, with 95 % intervals."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

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


class Column(NamedTuple):
    """Column of numbers: its heading in Markdown, and the smallest and largest possible value."""

    head: str
    low: float = -np.inf
    high: float = np.inf


MEASURED = {
    "return": Column("return"),
    "success_rate": Column("success", 0, 1),
    "steps": Column("steps", 0),
    "perceived_return": Column("perceived return"),
    "perceived_success_rate": Column("perceived success", 0, 1),
    "perceived_steps": Column("perceived steps", 0),
    "age": Column("age", 0),
    "late": Column("late", 0, 1),
    "lost": Column("lost", 0, 1),
    "backupdated": Column("back-updated", 0, 1),
}
"""Means over seeds, by measure. The first ones are of an ``Evaluation``: from messages without delay and,
``perceived_``, as the server perceived them."""
COMPARED = {
    "J_norm": Column("J_norm"),
    "recovery": Column("recovery"),
    "improvement": Column("P > naive"),
}
"""What is found of an arm beside others under the same delay: J_norm is 0 for the random policy, 1 for the
undelayed arm; recovery is 0 for the strongest naive arm of the same track and 1 for the undelayed one;
improvement: the probability that a run beats one of that naive arm."""
RUN = ["task", "delay", "arm", "seed"]
"""Columns of results that name a run."""
ENDS = ("", "_low", "_high")
"""Endings of the columns that hold a value and the ends of its 95 % interval."""
COLUMNS = ["task", "delay", "arm", "regime", "policy", "seeds", "compared_seeds"]
COLUMNS += [name + end for name in (*MEASURED, *COMPARED) for end in ENDS]
"""Columns of ``Comparison.table``."""


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


def shown(line: Mapping[Any, Any], name: str) -> str:
    """A value of a line and its interval, if they are known, for people."""
    value, low, high = (line[name + end] for end in ENDS)
    if np.isnan(value):
        return "-"
    numbers = (f"{x:.3f}" if abs(x) < 10 else f"{x:.1f}" for x in (value, low, high))
    return "{} [{}, {}]".format(*numbers) if not np.isnan(low) else next(numbers)


def _estimates(
    names: Sequence[str],
    statistic: Callable[[Floats], Floats],
    scores: Floats,
    bounds: tuple[Any, Any] = (-np.inf, np.inf),
) -> dict[str, float]:
    """Columns (``ENDS``) of a statistic from ``scores`` [strata, ..., seeds] to a number for each name."""
    found = bootstrap(statistic, scores, bounds=bounds)
    triples = zip(names, *(np.ravel(x).tolist() for x in found), strict=True)
    return {name + end: x for name, *triple in triples for end, x in zip(ENDS, triple, strict=True)}


def means_over_seeds(runs: pd.DataFrame) -> dict[str, float]:
    """Columns (``ENDS``) of the mean of each measure, from a column of ``runs``, with a row for each seed."""
    bounds = np.array([MEASURED.get(name, Column(name))[1:] for name in runs.columns]).T
    return _estimates([*map(str, runs)], lambda drawn: drawn.mean(-1)[..., 0, :], _scores(runs), (*bounds,))


def _scores(runs: pd.DataFrame) -> Floats:
    """Columns of a table with a row for each seed, as one stratum [1, columns, seeds]."""
    return np.ascontiguousarray(runs.to_numpy(dtype=float).T)[None]


@dataclass(frozen=True)
class Comparison:
    """Results of all runs, and the statistics that follow from them.

    ``rows`` has an evaluation of each run and policy: task, delay, arm, regime, seed, policy, episodes,
    ``MEASURED``, and of the run ``frames`` (environment steps in training) and ``seconds``. ``points`` are
    those of learning curves: task, delay, arm, seed, frames, episodes, and measures in training. Unknown
    or meaningless numbers are nan.
    """

    rows: pd.DataFrame
    points: pd.DataFrame
    arms: Mapping[str, Arm]
    score: str = "return"
    """Measure that is the J of J_norm and recovery."""
    policy: str = TRAINED
    """Policy with which the arms are compared, ``TRAINED`` or ``TRAINED_DETERMINISTIC``."""

    def tasks(self) -> list[str]:
        """Tasks with a finished run."""
        return [*self.rows["task"].unique()]

    def delays(self, task: str) -> list[str]:
        """Delays of a task with a finished run, without ``NOT_LATE``."""
        found = self.rows.loc[self.rows["task"] == task, "delay"].unique()
        return [name for name in found if name != NOT_LATE]

    def runs(self) -> pd.DataFrame:
        """The first row of each run."""
        return self.rows.drop_duplicates(RUN)

    @cached_property
    def curves(self) -> dict[tuple[Any, ...], list[pd.DataFrame]]:
        """Points of the learning curves by task, delay and arm, a table for each seed."""
        found: dict[tuple[Any, ...], list[pd.DataFrame]] = {}
        for (*name, _), points in self.points.groupby(RUN, sort=False):
            found.setdefault(tuple(name), []).append(points)
        return found

    def policy_of(self, arm: str) -> str:
        """The policy with which an arm is compared; an untrained arm has none but its untrained network."""
        return UNTRAINED_OF[self.policy] if self.arms[arm].untrained else self.policy

    @cached_property
    def table(self) -> pd.DataFrame:
        """A line for each task, delay, arm and policy, with ``COLUMNS``; the undelayed arm comes first."""
        return pd.DataFrame(self._lines(), columns=COLUMNS)

    def _lines(self) -> Iterator[dict[str, Any]]:
        for task in self.tasks():
            for delay in (NOT_LATE, *self.delays(task)):
                arms, scores = self._present(task, delay), self.scores(task, delay)
                for arm in arms:
                    labels = {"task": task, "delay": delay, "arm": arm, "regime": regime(self.arms, arm)}
                    compared = self._compared(scores, arm) if delay != NOT_LATE else {}
                    for policy in OF_ARM[2:] if self.arms[arm].untrained else OF_ARM:
                        numbers = compared if policy == self.policy_of(arm) else {}
                        yield from self._line(labels | {"policy": policy}, arm, numbers)
                for policy in SCRIPTED if arms else ():
                    labels = {"task": task, "delay": delay, "arm": policy, "regime": "", "policy": policy}
                    yield from self._line(labels, arms[0], {})

    def _line(
        self, labels: dict[str, str], arm: str, compared: Mapping[str, Any]
    ) -> Iterator[dict[str, Any]]:
        """The line of a policy, if it has flown: an arm may have no untrained network, and no script."""
        runs = self._evaluations.get((labels["task"], labels["delay"], arm, labels["policy"]))
        if runs is not None:
            yield {"seeds": len(runs), "compared_seeds": 0, **labels, **compared} | means_over_seeds(
                runs[[*MEASURED]]
            )

    @cached_property
    def _evaluations(self) -> dict[tuple[Any, ...], pd.DataFrame]:
        """Rows by task, delay, arm and policy, with the seed as their index."""
        grouped = self.rows.groupby([*RUN[:-1], "policy"], sort=False)
        return {name: found.set_index("seed") for name, found in grouped}

    def _present(self, task: str, delay: str) -> list[str]:
        """Arms that have a finished run of a task under a delay."""
        found = self.rows.loc[(self.rows["task"] == task) & (self.rows["delay"] == delay), "arm"].unique()
        return [name for name in self.arms if name in found]

    def scores(self, task: str, delay: str) -> pd.DataFrame:
        """Scores by seed, higher ones better, in a column for each arm; nan where a run is missing.

        The first columns are the undelayed arm and the random policy, without delay.
        """
        undelayed = next((name for name, arm in self.arms.items() if not arm.delayed), "")
        of = {undelayed: (NOT_LATE, undelayed, self.policy), RANDOM: (NOT_LATE, undelayed, RANDOM)}
        of |= {arm: (delay, arm, self.policy_of(arm)) for arm in self._present(task, delay)}
        none = pd.DataFrame({self.score: []}, dtype=float)
        found = {name: self._evaluations.get((task, *key), none)[self.score] for name, key in of.items()}
        return pd.DataFrame(found).sort_index() * (-1 if self.score in LESS_IS_BETTER else 1)

    def _compared(self, scores: pd.DataFrame, arm: str) -> dict[str, Any]:
        """``COMPARED`` of a delayed arm, over the seeds that it and all it is compared with have finished."""
        undelayed, random, *delayed = scores.columns
        others = [name for name in delayed if track(self.arms, name) == track(self.arms, arm)]
        naive = [name for name in others if self.arms[name].naive]
        paired = scores[[undelayed, random, *(name for name in naive if name != arm), arm]].dropna()
        if paired.empty:
            return {}
        array = _scores(paired)
        found = {"compared_seeds": len(paired), **_estimates(["J_norm"], _norms, array)}
        if naive and arm not in naive:
            probability = float(_improvement(array))
            ends = (probability, *improvement_interval(probability, len(paired)))
            found |= {f"improvement{end}": x for end, x in zip(ENDS, ends, strict=True)}
            if not np.isnan(_recovery(array, LEAST_GAP)):
                found |= _estimates(["recovery"], _recovery, array)
        return found

    def overall(self) -> dict[str, dict[str, float]]:
        """Number of ``seeds`` and interquartile mean of ``J_norm`` by delayed arm, over all tasks and delays.

        Held-out tasks do not count. Of the others, only the arms and delays that every one has do, and of
        each arm the seeds that it and the undelayed arm have everywhere; there must be two combinations of
        task and delay. Seeds are resampled within each task, because its delays share the undelayed arm.
        """
        by_task = {task: self.delays(task) for task in self.tasks() if HELD_OUT_MARK not in task}
        delays = [d for d in next(iter(by_task.values()), []) if all(d in ds for ds in by_task.values())]
        cells = [self.scores(task, delay) for task in by_task for delay in delays]
        if len(cells) < 2:
            return {}
        found, (undelayed, random, *arms) = {}, cells[0].columns
        for arm in [arm for arm in arms if all(arm in cell for cell in cells)]:
            columns = [cell[[undelayed, random, arm]] for cell in cells]
            runs = pd.concat(columns, axis=1).dropna().sort_index()
            if len(runs):
                by_cell = _scores(runs).reshape(len(by_task), len(delays), 3, len(runs))
                found[arm] = {"seeds": len(runs), **_estimates(["J_norm"], _interquartile_norms, by_cell)}
        return found


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


def _recovery(scores: Floats, least: float = 0.0) -> Floats:
    """Recovery of the last arm, [*, 1, arms, seeds] to [*]; before it undelayed, random and the naive."""
    means = scores.mean(-1)[..., 0, :]
    return recovery(means[..., -1], means[..., 2:-1].max(-1), means[..., 0], means[..., 1], least)


def _interquartile_norms(scores: Floats) -> Floats:
    """Interquartile mean of J_norm, [*, tasks, delays, 3, seeds] to [*]: undelayed, random and an arm."""
    means = scores.mean(-1, keepdims=True)
    norms = normalised(scores[..., 2, :], means[..., 0, :], means[..., 1, :])
    return interquartile_mean(norms.reshape(*norms.shape[:-3], -1))
