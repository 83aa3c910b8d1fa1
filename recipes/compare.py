"""Train and evaluate several arms with several seeds over tasks and delays, and compare their results.

damian compare experiment=usecases "tasks=[usecase2]" seeds=2 "overrides=['frames=1000','eval_episodes=8']"
damian compare experiment=delaybench report_only=true hydra.run.dir=docs/results/delaybench
"""

__package__ = "damian.recipes"  # also of a script: python recipes/compare.py

import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import hydra
import pandas as pd
from omegaconf import DictConfig

from damian.common import checks
from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError
from damian.common.tables import write_csv
from damian.compare.comparison import (
    HELD_OUT_MARK,
    NOT_LATE,
    RUN,
    TRAINED,
    TRAINED_DETERMINISTIC,
    Comparison,
)
from damian.compare.config import SEEDS, CompareConfig, HeldOut
from damian.compare.figures import plot_curves, plot_matrix, plot_norms
from damian.compare.report import markdown
from damian.compare.statistics import FEWEST
from damian.runs.interrupt import end_interrupted, number_of

from . import cli
from .evaluate import fly, fly_untrained
from .known import key_of, without
from .shared.comparison_results import FIGURE, MARKDOWN, NO_RESULTS, ROWS, Results, results_of, stored_results
from .shared.many_runs import LOG, Run, perform_all
from .shared.runs import check_policy_fits, check_stored, start
from .shared.settings import check_learning, late
from .train import train

TABLE, CURVES, MATRIX = "table.csv", "curves.png", "matrix.png"
EPISODES = 100
"""A report with an arm of fewer seeds, or with fewer episodes per evaluation, is marked as developing."""
POLICIES = {"sampled": TRAINED, "deterministic": TRAINED_DETERMINISTIC}


def plan(config: CompareConfig, folder: Path) -> list[Run]:
    """Every run with its checked settings: seed after seed, and last what flies others' policies."""
    tasks, delays = config.chosen("tasks"), {NOT_LATE: [], **config.chosen("delays")}
    places = {task: (task, HeldOut()) for task in tasks}
    for name, held_out in config.experiment.held_out.items():
        for task in tasks if held_out.tasks is None else [t for t in tasks if t in held_out.tasks]:
            places[f"{task}{HELD_OUT_MARK}{name}"] = (task, held_out)
    runs = [
        run
        for place, (task, held_out) in places.items()
        for delay, delay_overrides in delays.items()
        for name, arm in config.chosen("arms").items()
        if arm.delayed == (delay != NOT_LATE) and (arm.tasks is None or task in arm.tasks)
        if (held_out.arms is None or name in held_out.arms)
        and (held_out.delays is None or delay in held_out.delays)
        for changed in [[key_of(word) for word in held_out.overrides]]  # delay=paper replaces delay.obs=4
        for overrides in [[*without([*tasks[task], *delay_overrides], changed), *held_out.overrides]]
        for run in _seeds(config, folder / place / delay / name, task, overrides)
    ]
    by_folder = {run.folder: run.config for run in runs}
    for run in runs:
        if run.config.checkpoint is not None:
            try:
                check_policy_fits(run.config, by_folder[Path(run.config.checkpoint)])
            except InputError as error:
                raise InputError(f"{run.task}/{run.delay}/{run.arm}: {error}") from None
    succeeds = any(run.config.episode.success_share is not None for run in runs)
    should = "is in none of the tasks anything that can be reached: choose return or perceived_return"
    checks.require(succeeds or "success" not in config.score, "score", config.score, should)
    return sorted(runs, key=lambda run: (run.stage, run.config.seed))


def _seeds(config: CompareConfig, folder: Path, trained_in: str, overrides: list[str]) -> Iterator[Run]:
    """The runs of one task, delay and arm, which the folder names."""
    task, delay, name = folder.parts[-3:]
    arm, arms = config.experiment.arms[name], config.experiment.arms
    away = task != trained_in  # a held-out task, where nothing is trained
    flown = arm.policy_of or (name if away and not arm.untrained else None)
    source = flown or arm.source
    overrides = ["logger=csv", *overrides, *arm.overrides, *config.overrides]
    try:
        unseeded = _composed(*overrides)
        late_by = [] if arm.delayed else late(unseeded)
        if late_by and away:
            return  # a held-out delay, under which the undelayed arm is not flown
        should = "delays this arm, with which others are compared: put delays under experiment.delays"
        checks.require(not late_by, ", ".join(late_by), "its value", should)
        if flown is None and not arm.untrained:
            able = not arm.teacher or hasattr(unseeded.learner, "teacher")
            checks.require(able, "learner", unseeded.learner.name, "has no setting teacher")
            check_learning(unseeded)
    except InputError as error:
        raise InputError(f"{task}/{delay}/{name}: {error}") from None
    for seed in config.every_seed:
        policy, seed_folder = None, f"seed_{seed}"
        seeded = replace(unseeded, seed=seed, overrides=[*overrides, f"seed={seed}"])
        if source:
            source_delay = delay if arms[source].delayed else NOT_LATE
            policy = folder.parents[2] / trained_in / source_delay / source / seed_folder
            if flown or arm.starts_from:
                seeded = replace(seeded, checkpoint=str(policy))
            else:
                seeded = replace(seeded, learner=replace(seeded.learner, teacher=str(policy)))
        program = fly_untrained if arm.untrained else fly if flown else train
        yield Run(task, delay, name, seeded, folder / seed_folder, program, program is train, policy)


_composed = cache(cli.settings)  # several arms differ only in whose policy they fly; Hydra takes 0.2 s


def includes(config: CompareConfig, rows: pd.DataFrame) -> "pd.Series[bool]":
    """Which rows of results are of a task, a delay, an arm and a seed that are asked for."""
    tasks, first = [*config.chosen("tasks")], config.experiment.first_seed
    tasks += [f"{task}{HELD_OUT_MARK}{name}" for task in tasks for name in config.experiment.held_out]
    asked = {"task": tasks, "delay": [NOT_LATE, *config.chosen("delays")], "arm": [*config.chosen("arms")]}
    last = math.inf if config.seeds is None else config.every_seed[-1]
    return rows[[*asked]].isin(asked).all(axis=1) & rows["seed"].between(first, last)


def report(config: CompareConfig, results: Results, missing: Sequence[str], folder: Path) -> None:
    """Write the tables and the figures."""
    comparison = Comparison(*results, config.chosen("arms"), config.score, POLICIES[config.policy])
    write_csv(folder / TABLE, comparison.table, unknown="")
    write_atomically(folder / MARKDOWN, markdown(comparison, _notes(config, results.rows, missing)))
    plot_curves(comparison, folder / CURVES)
    plot_norms(comparison, folder / FIGURE)
    plot_matrix(comparison, folder / MATRIX)


def _notes(config: CompareConfig, rows: pd.DataFrame, missing: Sequence[str]) -> list[str]:
    """Lines above the tables: the command, the number of seeds and episodes, what the columns mean."""
    seeds, episodes = rows["seed"], sorted(rows["episodes"].astype(int).unique())
    notes = [
        f"`{cli.command()}`",
        f"{seeds.nunique()} seeds ({seeds.min()} to {seeds.max()}), "
        f"{' or '.join(map(str, episodes))} episodes each",
        "Mean over seeds [95 % interval: bootstrap over seeds, widened for few seeds; none below "
        f"{FEWEST}]; J: {config.score} of the {config.policy} policy; perceived: as far as the server knew, "
        "else as it truly was; age in steps; backupdated: share of the rewards in training; n: seeds",
        "J_norm: 0 random, 1 undelayed; recovery: 0 the strongest naive method of the same track (R0, or R1 "
        "and R2), 1 undelayed, not shown where "
        "the delay costs less than a tenth of undelayed - random; P > naive: probability that a run beats "
        "one of the strongest naive method, with its score interval; n compared: seeds that all have",
    ]
    if rows.groupby(RUN[:-1])["seed"].nunique().min() < SEEDS or episodes[0] < EPISODES:
        notes.insert(0, f"**developing**: fewer than {SEEDS} seeds or {EPISODES} episodes")
    return notes + ([f"missing: {', '.join(missing)}"] if missing else [])


def compare(config: CompareConfig, folder: Path) -> None:
    """Carry out the runs of a comparison that are not finished, and report on them."""
    has_runs = any((folder / task).exists() for task in config.experiment.tasks)
    if config.report_only and (folder / ROWS).exists() and not has_runs:
        results, missing, failed = stored_results(folder), [], []
    else:
        if config.report_only and config.seeds is None:  # all up to the last one with a run
            names = (path.name.removeprefix("seed_") for path in folder.glob("*/*/*/seed_*"))
            last = max((int(name) for name in names if name.isdecimal()), default=-1)
            config = replace(config, seeds=max(last - config.experiment.first_seed + 1, 0) or None)
        results, missing, failed = _results_of_runs(config, folder)
    results = results.only(partial(includes, config))
    if results.rows.empty:
        raise InputError(f"experiment: no run of it is finished in {folder}; leave out report_only")
    report(config, results, missing, folder)
    print((folder / MARKDOWN).read_text(encoding="utf-8"))
    print(f"results: {cli.short(folder)}")
    if failed:
        sys.exit(1)


def _results_of_runs(config: CompareConfig, folder: Path) -> tuple[Results, list[str], list[Run]]:
    """Carry out the runs, unless only a report is asked for, and store the rows of each as it finishes."""
    runs, arms, failed, kept = plan(config, folder), config.chosen("arms"), [], NO_RESULTS
    if config.keep and (folder / ROWS).exists():
        kept = stored_results(folder)
        runs = _not_kept(runs, kept)
    for run in runs:
        check_stored(run.config, run.folder)
    stored = kept.with_those_of(results_of([run for run in runs if run.finished], arms))

    def store(run: Run) -> None:
        nonlocal stored
        stored = stored.with_those_of(results_of([run], arms))
        stored.write(folder)

    try:
        if not config.report_only:
            failed = perform_all(runs, config.processes, (POLICIES[config.policy], config.score), store)
    except KeyboardInterrupt as error:
        end_interrupted(number_of(error), "run the same command again to continue")
    for run in failed:
        print(f"failed: {run.name}; see {run.folder / LOG}", file=sys.stderr)
    done = [run for run in runs if run.finished]
    if failed and not done:
        sys.exit(1)
    results = kept.with_those_of(results_of(done, arms))  # in the order of the plan
    if done:
        results.write(folder)
    return results, [run.name for run in runs if not run.finished], failed


def _not_kept(runs: list[Run], kept: Results) -> list[Run]:
    """The runs without kept results, or with a folder, and those whose policies they need."""
    done = {*kept.rows[RUN].itertuples(index=False, name=None)}
    todo = [r for r in runs if (r.task, r.delay, r.arm, r.config.seed) not in done or r.folder.exists()]
    needed = {run.needs for run in todo if not run.finished}
    needed |= {run.needs for run in runs if run.folder in needed}
    return [run for run in runs if run in todo or run.folder in needed]


@cli.one_line_errors("compare")
@hydra.main(config_path="../conf", config_name="compare", version_base=None)
def main(given: DictConfig) -> None:
    start(compare, given, "compare", again=True)


if __name__ == "__main__":
    main()
