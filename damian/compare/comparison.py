"""Comparison of arms over tasks, delays and seeds: means, J_norm and recovery, with 95 % intervals."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from damian.compare.config import LESS_IS_BETTER, Arm
from damian.compare.statistics import (
    Floats,
    bootstrap,
    improvement_interval,
    normalised,
    probability_of_improvement,
    recovery,
)
from damian.runs.run_folder import DETERMINISTIC, RANDOM, SCRIPT, TRAINED, UNTRAINED

SCRIPTED = (RANDOM, SCRIPT)
"""Policies that fly the same episodes beside each arm, and learn nothing."""
OF_ARM = (TRAINED, TRAINED + DETERMINISTIC, UNTRAINED, UNTRAINED + DETERMINISTIC)
"""Policies of an arm: its network after the training and before the first update."""
HELD_OUT_MARK = "@"
"""Stands between a task and a change of it under which the task's policies fly untrained."""
NOT_LATE = "none"
"""Name that stands for the delay of an undelayed arm."""
MEASURED = (
    "return",
    "success_rate",
    "steps",
    "perceived_return",
    "perceived_success_rate",
    "perceived_steps",
)
MEASURED += ("age", "late", "lost", "backupdated")
"""Measures whose means over seeds are shown: most are of an ``Evaluation``."""
SHARES = ("success_rate", "perceived_success_rate", "late", "lost", "backupdated")
"""Measures whose intervals end at 0 and at 1."""
COMPARED = ("J_norm", "recovery", "improvement")
"""What is found of an arm beside others under the same delay (``normalised``, ``recovery``,
``probability_of_improvement``), the naive arm being the strongest one of the same track: arms that learn from
late data only (R0), or those that had a simulator."""
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
    if arm.regime or not arm.delayed:
        return arm.regime or "R3"
    if arm.source is None:
        return "R0"
    return "R2" if not arms[arm.source].delayed else regime(arms, arm.source)


def shown(line: Mapping[Any, Any], name: str) -> str:
    """A value of a line and its interval, if they are known, for people."""
    value, low, high = (line[name + end] for end in ENDS)
    if np.isnan(value):
        return "-"
    numbers = (f"{x:.3f}" if abs(x) < 10 else f"{x:.1f}" for x in (value, low, high))
    return "{} [{}, {}]".format(*numbers) if not np.isnan(low) else next(numbers)


def _estimates(
    names: Sequence[str], statistic: Callable[[Floats], Floats], scores: Floats
) -> dict[str, float]:
    """Columns (``ENDS``) of a statistic from ``scores`` [arms, seeds] to a number for each name."""
    triples = zip(names, *(np.ravel(x).tolist() for x in bootstrap(statistic, scores)), strict=True)
    return {name + end: x for name, *triple in triples for end, x in zip(ENDS, triple, strict=True)}


def means_over_seeds(runs: pd.DataFrame) -> dict[str, float]:
    """Columns (``ENDS``) of the mean of each measure, from a column of ``runs``, with a row for each seed."""
    found = _estimates([*map(str, runs)], lambda drawn: drawn.mean(-1), _scores(runs))
    shares = [name + end for name in SHARES for end in ENDS if name in runs]
    return found | {name: float(np.clip(found[name], 0, 1)) for name in shares}


def improvement(scores: Floats, others: Floats) -> dict[str, float]:
    """Columns (``ENDS``) of the probability that a run beats another, from scores by seed, [seeds] each."""
    probability = float(probability_of_improvement(scores, others))
    ends = (probability, *improvement_interval(probability, len(scores)))
    return {f"improvement{end}": x for end, x in zip(ENDS, ends, strict=True)}


def _scores(runs: pd.DataFrame) -> Floats:
    """Columns of a table with a row for each seed, [columns, seeds]."""
    return np.ascontiguousarray(runs.to_numpy(dtype=float).T)


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

    def tasks(self) -> list[str]:
        """Tasks with a finished run."""
        return [*self.rows["task"].unique()]

    def delays(self, task: str) -> list[str]:
        """Delays of a task with a finished run, without ``NOT_LATE``."""
        found = self.rows.loc[self.rows["task"] == task, "delay"].unique()
        return [name for name in found if name != NOT_LATE]

    @cached_property
    def curves(self) -> dict[tuple[Any, ...], list[pd.DataFrame]]:
        """Points of the learning curves by task, delay and arm, a table for each seed."""
        found: dict[tuple[Any, ...], list[pd.DataFrame]] = {}
        for (*name, _), points in self.points.groupby(RUN, sort=False):
            found.setdefault(tuple(name), []).append(points)
        return found

    def policy_of(self, arm: str) -> str:
        """The policy with which an arm is compared; an untrained arm has none but its untrained network."""
        return UNTRAINED if self.arms[arm].untrained else TRAINED

    @cached_property
    def table(self) -> pd.DataFrame:
        """A line for each task, delay, arm and policy, with ``COLUMNS``; the undelayed arm comes first."""
        return pd.DataFrame(self._lines(), columns=COLUMNS)

    def _lines(self) -> Iterator[dict[str, Any]]:
        for task in self.tasks():
            for delay in (NOT_LATE, *self.delays(task)):
                scores = self.scores(task, delay)
                arms = self._present(task, delay)
                names = [(arm, arm, policy) for arm in arms for policy in OF_ARM]
                names += [(policy, arm, policy) for policy in SCRIPTED for arm in arms[:1]]
                for name, arm, policy in names:
                    runs = self._runs.get((task, delay, arm, policy))
                    if runs is None:
                        continue  # an arm may have no untrained network, and a task no script
                    line = {"task": task, "delay": delay, "arm": name, "policy": policy, "seeds": len(runs)}
                    line |= {"regime": regime(self.arms, arm) if name == arm else "", "compared_seeds": 0}
                    if name == arm and policy == self.policy_of(arm) and delay != NOT_LATE:
                        line |= self._compared(scores, arm)
                    yield line | means_over_seeds(runs[[*MEASURED]])

    @cached_property
    def _runs(self) -> dict[tuple[Any, ...], pd.DataFrame]:
        """Rows by task, delay, arm and policy, with the seed as their index."""
        grouped = self.rows.groupby([*RUN[:-1], "policy"], sort=False)
        return {name: found.set_index("seed") for name, found in grouped}

    def scores(self, task: str, delay: str) -> pd.DataFrame:
        """Scores by seed, higher ones better, in a column for each arm; nan where a run is missing.

        The first columns are the undelayed arm and the random policy, without delay.
        """
        undelayed = next((name for name, arm in self.arms.items() if not arm.delayed), "")
        of = {undelayed: (NOT_LATE, undelayed, TRAINED), RANDOM: (NOT_LATE, undelayed, RANDOM)}
        of |= {arm: (delay, arm, self.policy_of(arm)) for arm in self._present(task, delay)}
        none = pd.DataFrame({self.score: []}, dtype=float)
        found = {name: self._runs.get((task, *key), none)[self.score] for name, key in of.items()}
        return pd.DataFrame(found).sort_index() * (-1 if self.score in LESS_IS_BETTER else 1)

    def _present(self, task: str, delay: str) -> list[str]:
        """Arms that have a finished run of a task under a delay."""
        return [arm for arm in self.arms if (task, delay, arm, self.policy_of(arm)) in self._runs]

    def _compared(self, scores: pd.DataFrame, arm: str) -> dict[str, Any]:
        """``COMPARED`` of a delayed arm, over the seeds that it and all it is compared with have finished."""
        undelayed, random, *delayed = scores.columns
        tracks = {name: regime(self.arms, name) == "R0" for name in (*delayed, arm)}
        others = [name for name in delayed if tracks[name] == tracks[arm]]
        naive = [name for name in others if self.arms[name].naive]
        paired = scores[[undelayed, random, *(name for name in naive if name != arm), arm]].dropna()
        if paired.empty:
            return {}
        array = _scores(paired)
        found = {"compared_seeds": len(paired), **_estimates(["J_norm"], _norms, array)}
        if naive and arm not in naive:
            _, _, *of_naive, own = array
            found |= improvement(own, max(of_naive, key=np.mean))
            if not np.isnan(recovery(array)):
                found |= _estimates(["recovery"], lambda drawn: recovery(drawn, 0.0), array)
        return found


def _norms(scores: Floats) -> Floats:
    """J_norm of the last arm's mean score, [*, arms, seeds] to [*]; first come undelayed and random."""
    means = scores.mean(-1)
    return normalised(means[..., -1], means[..., 0], means[..., 1])
