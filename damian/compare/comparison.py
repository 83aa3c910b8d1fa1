"""Comparison of methods over tasks, delays and seeds: means, J_norm and recovery, with 95 %
intervals."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from damian.compare.config import Method
from damian.compare.statistics import (
    Floats,
    bootstrap,
    improvement_interval,
    normalised,
    probability_of_improvement,
    recovery,
)
from damian.runs.measures import declared
from damian.runs.run_folder import (
    DETERMINISTIC,
    PLANNER,
    RANDOM,
    SCRIPT,
    TRAINED,
    UNTRAINED,
    measured_in,
)

SCRIPTED = (RANDOM, SCRIPT)
"""Policies that fly the same episodes beside each method, and learn nothing."""
OF_METHOD = (TRAINED, TRAINED + DETERMINISTIC, UNTRAINED, UNTRAINED + DETERMINISTIC)
"""Policies of a method: its network after the training and before the first update."""
HELD_OUT_MARK = "@"
"""Stands between a task and a change of it under which the task's policies fly untrained."""
NOT_LATE = "none"
"""Name that stands for the delay of an undelayed method."""
CORRECTED = "backupdated"
"""Share of the steps of a training whose rewards late messages have changed."""
COMPARED = ("J_norm", "recovery", "improvement")
"""Statistics of a method under a delay (``normalised``, ``recovery``,
``probability_of_improvement``). The
naive method in them is the strongest of the same track: late data only, or simulator allowed."""
LATE_DATA, SIMULATOR, NO_DELAY = "late data", "simulator", "no delay"
WORLD_MODEL = "world model"
"""Regimes: the information that a method may use (docs/protocol.md)."""
RUN = ["task", "delay", "method", "seed"]
"""Columns of results that name a run."""
ENDS = ("", "_low", "_high")
"""Endings of the columns that hold a value and the ends of its 95 % interval."""
LABELLED = ["task", "delay", "method", "regime", "policy", "seeds", "compared_seeds"]
"""First columns of ``Comparison.table``."""


def regime(methods: Mapping[str, Method], name: str) -> str:
    """The regime of a method: ``LATE_DATA``, ``SIMULATOR``, ``WORLD_MODEL`` or ``NO_DELAY``."""
    method = methods[name]
    if not method.delayed:
        return NO_DELAY
    if method.has_model:
        return WORLD_MODEL
    simulated = bool(method.simulator)
    if method.simulator is None and method.source:
        simulated = regime(methods, method.source) != LATE_DATA
    return SIMULATOR if simulated else LATE_DATA


def shown(line: Mapping, name: str) -> str:
    """A value of a line and its interval, if they are known, for people."""
    value, low, high = (line[name + end] for end in ENDS)
    if np.isnan(value):
        return "-"
    numbers = [value, low, high]
    largest = np.nanmax(np.abs(numbers))
    decimals = 3 - int(largest >= 1) - int(largest >= 10)
    texts = [f"{x:.{decimals}f}" for x in numbers]
    return texts[0] if np.isnan(low) else "{} [{}, {}]".format(*texts)


def _estimates(
    names: Sequence[str], statistic: Callable[[Floats], Floats], scores: Floats
) -> dict[str, float]:
    """Columns (``ENDS``) of a statistic from ``scores`` [methods, seeds] to a number for each
    name."""
    estimates = {}
    for end, values in zip(ENDS, bootstrap(statistic, scores), strict=True):
        columns = [name + end for name in names]
        estimates |= zip(columns, np.ravel(values).tolist(), strict=True)
    return estimates


def means_over_seeds(runs: pd.DataFrame) -> dict[str, float]:
    """Columns (``ENDS``) of the mean of each measure, from a column of ``runs``, with a row for
    each seed."""
    names = [*map(str, runs)]
    found = _estimates(names, lambda drawn: drawn.mean(-1), _scores(runs))
    for name in names:
        if not (declared(name).share or name == CORRECTED):
            continue
        for end in ENDS:
            found[name + end] = float(np.clip(found[name + end], 0, 1))
    return found


def improvement(scores: Floats, others: Floats) -> dict[str, float]:
    """Columns (``ENDS``) of the probability that a run beats another, from scores by seed, [seeds]
    each."""
    probability = float(probability_of_improvement(scores, others))
    values = (probability, *improvement_interval(probability, len(scores)))
    return {f"improvement{end}": x for end, x in zip(ENDS, values, strict=True)}


def sign_of(score: str) -> int:
    """1 if higher values of a metric are better, -1 if lower ones are."""
    return -1 if declared(score).better == "lower" else 1


def _scores(runs: pd.DataFrame) -> Floats:
    """Columns of a table with a row for each seed, [columns, seeds]."""
    return np.ascontiguousarray(runs.to_numpy(dtype=float).T)


@dataclass(frozen=True)
class Comparison:
    """Results of all runs, and the statistics that follow from them.

    ``rows`` has an evaluation of each run and policy: task, delay, method, regime, seed, policy,
    episodes, its metrics, and of the run ``frames`` (environment steps in training) and
    ``seconds``. ``points`` are
    those of learning curves: task, delay, method, seed, frames, episodes, and measures in training.
    Unknown or meaningless numbers are nan.
    """

    rows: pd.DataFrame
    points: pd.DataFrame
    methods: Mapping[str, Method]
    score: str = "return"
    """Measure that is the J of J_norm and recovery."""

    @property
    def undelayed(self) -> str:
        """Name of the undelayed method, with which others are compared."""
        return next((name for name, method in self.methods.items() if not method.delayed), "")

    def tasks(self) -> list[str]:
        """Tasks with a finished run."""
        return [*self.rows["task"].unique()]

    def delays(self, task: str) -> list[str]:
        """Delays of a task with a finished run, without ``NOT_LATE``."""
        of_task = self.rows["task"] == task
        found = self.rows.loc[of_task, "delay"].unique()
        return [name for name in found if name != NOT_LATE]

    @property
    def measured(self) -> list[str]:
        """Measures whose means over seeds are shown: the score, other metrics, ``CORRECTED``."""
        return [*measured_in(self.rows, self.score), CORRECTED]

    @cached_property
    def curves(self) -> dict[tuple[Any, ...], list[pd.DataFrame]]:
        """Points of the learning curves by task, delay and method, a table for each seed."""
        found: dict[tuple[Any, ...], list[pd.DataFrame]] = {}
        for (*name, _), points in self.points.groupby(RUN, sort=False):
            found.setdefault(tuple(name), []).append(points)
        return found

    def policy_of(self, method: str) -> str:
        """The policy with which a method is compared: the trained one, if it trains any."""
        return self.methods[method].flies or TRAINED

    @cached_property
    def table(self) -> pd.DataFrame:
        """A line for each task, delay, method and policy, first the undelayed method.

        Behind the columns ``LABELLED`` stand those of ``measured`` and ``COMPARED``, three each
        (``ENDS``).
        """
        names = (*self.measured, *COMPARED)
        columns = [name + end for name in names for end in ENDS]
        lines = (
            line
            for task in self.tasks()
            for delay in (NOT_LATE, *self.delays(task))
            for line in self._lines(task, delay)
        )
        return pd.DataFrame(lines, columns=[*LABELLED, *columns])

    def _lines(self, task: str, delay: str) -> Iterator[dict[str, Any]]:
        scores = self.scores(task, delay)
        methods = self._present(task, delay)
        others = [(name, self.policy_of(name)) for name in methods]
        others = [pair for pair in others if pair[1] in (SCRIPT, PLANNER)]
        beside = [(name, policy) for name in methods[:1] for policy in SCRIPTED]
        beside = [pair for pair in beside if pair not in others]
        flown = [*product(methods, OF_METHOD), *others, *beside]
        for method, policy in flown:
            runs = self._runs.get((task, delay, method, policy))
            if runs is None:
                continue  # a method may have no untrained network, and a task no script
            line = {
                "task": task,
                "delay": delay,
                "method": method,
                "policy": policy,
                "regime": regime(self.methods, method),
                "seeds": len(runs),
                "compared_seeds": 0,
            }
            own = policy == self.policy_of(method)
            if policy in SCRIPTED and not own:
                line |= {"method": policy, "regime": ""}
            elif own and delay != NOT_LATE:
                line |= self._compared(scores, method)
            yield line | means_over_seeds(runs[self.measured])

    @cached_property
    def _runs(self) -> dict[tuple[Any, ...], pd.DataFrame]:
        """Rows by task, delay, method and policy, with the seed as their index."""
        grouped = self.rows.groupby([*RUN[:-1], "policy"], sort=False)
        return {name: found.set_index("seed") for name, found in grouped}

    def scores(self, task: str, delay: str) -> pd.DataFrame:
        """Scores by seed, higher ones better, in a column for each method; nan where a run is
        missing.

        The first columns are the undelayed method and the random policy, without delay.
        """
        undelayed = self.undelayed
        of = {
            undelayed: (task, NOT_LATE, undelayed, TRAINED),
            RANDOM: (task, NOT_LATE, undelayed, RANDOM),
        }
        for method in self._present(task, delay):
            of[method] = (task, delay, method, self.policy_of(method))
        none = pd.DataFrame({self.score: []}, dtype=float)
        found = {name: self._runs.get(run, none)[self.score] for name, run in of.items()}
        return pd.DataFrame(found).sort_index() * sign_of(self.score)

    def _present(self, task: str, delay: str) -> list[str]:
        """Methods that have a finished run of a task under a delay."""
        runs = {name: (task, delay, name, self.policy_of(name)) for name in self.methods}
        return [name for name, run in runs.items() if run in self._runs]

    def _compared(self, scores: pd.DataFrame, method: str) -> dict[str, Any]:
        """``COMPARED`` of a delayed method, over the seeds that it and its rivals have finished."""
        undelayed, random, *delayed = scores.columns
        naive = [name for name in delayed if self.methods[name].naive]
        from_late_data = {name for name in delayed if regime(self.methods, name) == LATE_DATA}
        rivals = [name for name in naive if (name in from_late_data) == (method in from_late_data)]
        is_rival = method in rivals
        if is_rival:
            rivals.remove(method)
        paired = scores[[undelayed, random, *rivals, method]].dropna()
        if paired.empty:
            return {}
        array = _scores(paired)
        found = {"compared_seeds": len(paired)}
        found |= _estimates(["J_norm"], _norms, array)
        if rivals and not is_rival:
            _, _, *of_rivals, own = array
            found |= improvement(own, max(of_rivals, key=np.mean))
            if not np.isnan(recovery(array)):
                found |= _estimates(["recovery"], lambda drawn: recovery(drawn, 0.0), array)
        return found


def _norms(scores: Floats) -> Floats:
    """J_norm of the last method's mean score, [*, methods, seeds] to [*]; first come undelayed and
    random."""
    means = scores.mean(-1)
    return normalised(means[..., -1], means[..., 0], means[..., 1])
