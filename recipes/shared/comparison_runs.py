"""The runs of a comparison, several at a time, each in a folder with its output in log.txt; their results.

Finished runs are not repeated, and interrupted ones go on. The rows of all evaluations and the learning
curves are two CSV files, which are enough for all tables and figures, without the folders of the runs.
"""

import math
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from tqdm import tqdm

from damian.common import checks
from damian.common.atomic_files import make_folder, not_linked
from damian.common.errors import InputError, RunError
from damian.compare.comparison import HELD_OUT_MARK, NOT_LATE, OF_METHOD, RUN, Method, regime
from damian.compare.config import CompareConfig, HeldOut
from damian.compare.figures import LABELS
from damian.runs.measures import BUILT_IN
from damian.runs.metrics_log import read_metrics
from damian.runs.processes import each_in_processes
from damian.runs.run_folder import RESULTS, check_no_links, read_results
from damian.runs.run_record import read_record

from .. import cli
from ..cli import Work
from ..config import TrainConfig
from ..known import key_of
from .runs import check_policy_fits, finished, perform
from .settings import check_learning, late

LOG = "log.txt"


@dataclass(frozen=True)
class Run:
    """One seed of a method, for one task and delay."""

    task: str
    delay: str
    method: str
    config: TrainConfig
    folder: Path
    trains: bool
    """Whether it trains a policy; if not, it flies one, or the untrained networks."""
    needs: Path | None = None
    """Folder of the run whose policy this one flies, starts from, or imitates, if it does so."""

    @property
    def name(self) -> str:
        return "/".join(self.folder.parts[-4:])

    @property
    def stage(self) -> int:
        """Runs of stage 0 need no others, those of stage 1 learn from them, and those of stage 2 fly them."""
        return 2 if not self.trains else int(self.needs is not None)

    @property
    def finished(self) -> bool:
        """Whether the run has results, and if it flies another's policy, of that policy as it is now."""
        return finished(self.config, self.folder)


def plan(config: CompareConfig, folder: Path) -> list[Run]:
    """Every run with its checked settings: seed after seed, and last what flies others' policies."""
    tasks, delays, runs = config.chosen("tasks"), {NOT_LATE: [], **config.chosen("delays")}, list[Run]()
    composed = cache(cli.settings)  # several methods differ only in whose policy they fly: 0.2 s each
    places = [(task, task, HeldOut()) for task in tasks]
    for name, held_out in config.experiment.held_out.items():
        places += [(f"{t}{HELD_OUT_MARK}{name}", t, held_out) for t in tasks if _in(held_out.tasks, t)]
    for (place, task, held_out), (delay, words) in product(places, delays.items()):
        for name, method in config.chosen("methods").items():
            fits = method.delayed == (delay != NOT_LATE) and _in(method.tasks, task)
            if fits and _in(held_out.methods, name) and _in(held_out.delays, delay):
                overrides = _replaced([*tasks[task], *words], held_out.overrides)
                runs += _seeds(config, composed, folder / place / delay / name, task, overrides)
    by_folder = {run.folder: run.config for run in runs}
    for run in runs:
        if run.config.checkpoint is not None:
            try:
                check_policy_fits(run.config, by_folder[Path(run.config.checkpoint)])
            except InputError as error:
                raise InputError(f"{run.task}/{run.delay}/{run.method}: {error}") from None
    succeeds = any(run.config.episode.can_succeed for run in runs)
    should = "is in none of the tasks anything that can be reached: choose return or perceived_return"
    checks.require(succeeds or "success" not in config.score, "score", config.score, should)
    measured = all(config.score in (*BUILT_IN, *run.config.metrics) for run in runs)
    should = f"is not measured by every run: add overrides=['metrics=[{config.score}]']"
    checks.require(measured, "score", config.score, should)
    return sorted(runs, key=lambda run: (run.stage, run.config.seed))


def _in(chosen: Sequence[str] | None, name: str) -> bool:
    return chosen is None or name in chosen


def _replaced(words: Sequence[str], by: Sequence[str]) -> list[str]:
    """Words without those that others replace, and the others: ``delay=paper`` replaces ``delay.obs=4``."""
    keys = tuple(f"{key_of(word)}." for word in by)
    return [*(word for word in words if not f"{key_of(word)}.".startswith(keys)), *by]


def _seeds(
    config: CompareConfig,
    composed: Callable[..., TrainConfig],
    folder: Path,
    trained_in: str,
    overrides: list[str],
) -> Iterator[Run]:
    """The runs of one task, delay and method, which the folder names."""
    task, delay, name = folder.parts[-3:]
    method, methods = config.experiment.methods[name], config.experiment.methods
    away = task != trained_in  # a held-out task, where nothing is trained
    flown = method.policy_of or (name if away and not method.untrained else None)
    source = flown or method.source
    words = ["logger=csv", *overrides, *method.overrides, *config.overrides]
    try:
        unseeded = composed(*words)
        late_by = [] if method.delayed else late(unseeded.make_delays())
        if late_by and away:
            return  # a held-out delay, under which the undelayed method is not flown
        should = "delays this method, with which others are compared: put delays under experiment.delays"
        checks.require(not late_by, ", ".join(late_by), "its value", should)
        if flown is None and not method.untrained:
            able = not method.teacher or hasattr(unseeded.learner, "teacher")
            checks.require(able, "learner", unseeded.learner.name, "has no setting teacher")
            check_learning(unseeded)
    except InputError as error:
        raise InputError(f"{task}/{delay}/{name}: {error}") from None
    for seed in config.every_seed:
        policy, seed_folder = None, f"seed_{seed}"
        seeded = replace(unseeded, seed=seed, overrides=[*words, f"seed={seed}"])
        if source:
            source_delay = delay if methods[source].delayed else NOT_LATE
            policy = folder.parents[2] / trained_in / source_delay / source / seed_folder
            if flown or method.starts_from:
                seeded = replace(seeded, checkpoint=str(policy))
            else:
                seeded = replace(seeded, learner=replace(seeded.learner, teacher=str(policy)))
        trains = not (method.untrained or flown)
        yield Run(task, delay, name, seeded, folder / seed_folder, trains, policy)


def perform_all(runs: Sequence[Run], processes: int, train: Work, fly: Work) -> list[Run]:
    """Carry out the runs that are not finished by training or flying; returns those that failed."""
    todo, failed = [run for run in runs if not run.finished], []
    with tqdm(total=len(runs), initial=len(runs) - len(todo), unit=" runs", disable=not todo) as bar:
        for stage in range(3):
            part = [run for run in todo if run.stage == stage]
            work = partial(perform_run, work=fly if stage == 2 else train)
            for run, error in each_in_processes(work, part, processes):
                bar.update()
                failed += [run] if error else []
    return failed


def perform_run(run: Run, work: Work) -> None:
    """Carry out one run, or go on with it."""
    make_folder(run.folder, below=run.folder.parents[3])
    with (
        not_linked(run.folder / LOG).open("a", encoding="utf-8", buffering=1) as log,
        redirect_stdout(log),
        redirect_stderr(log),
    ):
        try:
            if run.needs is not None and not (run.needs / RESULTS).exists():
                raise InputError(f"checkpoint: {run.needs} has no finished policy")
            perform(run.config, run.folder, work)
        except SystemExit:  # a signal has stopped the training
            raise KeyboardInterrupt from None
        except (InputError, RunError) as error:
            print(f"error: {error}")
            raise
        except BaseException:
            traceback.print_exc()
            raise
        finally:
            # Torch compiles a function at most eight times in a process. Policies with different observations
            # share one, so that the ninth would be slow without saying so.
            torch.compiler.reset()


ROWS, POINTS = "results.csv", "curves.csv"
MARKDOWN, FIGURE, PROFILES = "table.md", "figure.png", "profiles.png"
"""What follows from the rows; a sweep has the table, too."""
MOST_POINTS = 50
"""Largest number of points of a stored learning curve, evenly spaced over its updates."""
CURVE = [*RUN, "frames", "episodes", *LABELS]
"""Columns of the points of learning curves."""


class Results(NamedTuple):
    """Results of the finished runs of a comparison, as ``Comparison`` reads them."""

    rows: pd.DataFrame
    points: pd.DataFrame

    def with_those_of(self, new: "Results") -> "Results":
        """Both results; where both have a run, the new ones."""
        again = pd.MultiIndex.from_frame(new.rows[RUN])
        kept = (old[~pd.MultiIndex.from_frame(old[RUN]).isin(again)] for old in self)
        return Results(*map(_joined, zip(kept, new, strict=True)))


NO_RESULTS = Results(pd.DataFrame(columns=RUN), pd.DataFrame(columns=CURVE))


def results_of(runs: Sequence[Run], methods: Mapping[str, Method]) -> Results:
    """The results of finished runs."""
    found = [NO_RESULTS, *(_of_run(run, methods) for run in runs)]
    return Results(*map(_joined, zip(*found, strict=True)))


def _joined(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Tables below each other; those without rows tell pandas nothing about the columns."""
    return pd.concat([table for table in tables if len(table)] or [tables[0]], ignore_index=True)


def _of_run(run: Run, methods: Mapping[str, Method]) -> Results:
    label = {"task": run.task, "delay": run.delay, "method": run.method, "seed": run.config.seed}
    rows, metrics = read_results(run.folder / RESULTS), read_metrics(run.folder)
    of_run = {
        "regime": regime(methods, run.method),
        "frames": metrics["frames"].max() if len(metrics) else 0.0,
        "seconds": read_record(run.folder).get("wall_time_s", math.nan),
        "backupdated": fmean(metrics["backupdated"]) if "backupdated" in metrics else math.nan,
    }
    names = [*rows.columns]
    rows = rows.assign(**label, **of_run)[[*label, *of_run, *names]]
    rows.loc[~rows["policy"].isin(OF_METHOD[:2]), "backupdated"] = math.nan
    spread = np.linspace(0, len(metrics) - 1, min(len(metrics), MOST_POINTS)).round().astype(int)
    points = metrics.iloc[spread].reindex(columns=CURVE[len(RUN) :])
    points = points.map(lambda number: float(f"{number:.5g}")).assign(**label)[CURVE]
    if not run.config.episode.can_succeed:  # nothing can succeed, and a share of it means nothing
        for table in (rows, points):
            table[table.filter(like="success_rate").columns] = math.nan
    return Results(rows, points)


def stored_results(folder: Path, key: str = "folder") -> Results:
    """Read the results that a folder stores, but no curves of a version that drew perceived returns.

    Raises:
        InputError: it is not the folder of a comparison; ``key`` is the setting that names it.
    """
    is_whole = all((folder / name).is_file() for name in (ROWS, POINTS))
    problem = f"has no {ROWS} beside {POINTS}: give the folder of damian compare, not one of a run or a sweep"
    checks.require(is_whole, key, folder, problem)
    check_no_links(folder)
    rows, points = (read_results(folder / name) for name in (ROWS, POINTS))
    return Results(rows, points if LABELS.keys() <= {*points} else NO_RESULTS.points)
