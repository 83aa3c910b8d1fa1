"""Train and evaluate several methods with several seeds over tasks and delays, and compare their
results.

damian compare experiment=usecases "tasks=[usecase2]" seeds=2 "overrides=['frames=1000','eval_episodes=8']"
damian compare experiment=delaybench seeds=10 processes=2 "delays=[paper]" "methods=[undelayed,naive]"
damian compare experiment=delaybench report_only=true hydra.run.dir=docs/results/delaybench

The same command continues a comparison; keep=true also without the folders of finished runs.
"""

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path

import pandas as pd
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from damian.common import checks
from damian.common.atomic_files import not_linked, write_atomically
from damian.common.errors import InputError
from damian.common.tables import write_csv
from damian.common.text_files import named
from damian.compare.comparison import HELD_OUT_MARK, NOT_LATE, RUN, Comparison
from damian.compare.config import EPISODES, SEEDS, CompareConfig, HeldOut
from damian.compare.figures import plot_curves, plot_scores
from damian.compare.report import markdown
from damian.compare.statistics import FEWEST
from damian.runs.measures import BUILT_IN
from damian.runs.processes import end_interrupted
from damian.runs.run_folder import PLANNER, SCRIPT, check_no_links, locked

from . import cli
from .config import TrainConfig
from .evaluate import fly, fly_planner, fly_script
from .known import key_of
from .shared.runs import Run, check_policy_fits
from .shared.settings import check_learning, late
from .shared.sweeps import (
    LOG,
    MARKDOWN,
    NO_RESULTS,
    POINTS,
    ROWS,
    Results,
    names_of,
    perform_all,
    results_of,
    stored_results,
)
from .train import train

TABLE = "table.csv"
CURVES, FIGURE = "curves.png", "figure.png"


def plan(config: CompareConfig, folder: Path) -> list[Run]:
    """Every run with its checked settings: seed after seed, and last what flies others'
    policies."""
    tasks = config.chosen("tasks")
    delays = {NOT_LATE: [], **config.chosen("delays")}
    runs = list[Run]()
    composed = cache(
        cli.settings
    )  # several methods differ only in whose policy they fly: 0.2 s each
    places = [(task, task, HeldOut()) for task in tasks]
    for name, held_out in config.experiment.held_out.items():
        places += [
            (f"{t}{HELD_OUT_MARK}{name}", t, held_out) for t in tasks if _in(held_out.tasks, t)
        ]
    for (place, task, held_out), (delay, words) in product(places, delays.items()):
        for name, method in config.chosen("methods").items():
            fits = method.delayed == (delay != NOT_LATE) and _in(method.tasks, task)
            fits = fits and _in(method.delays, delay)
            if fits and _in(held_out.methods, name) and _in(held_out.delays, delay):
                overrides = _replaced([*tasks[task], *words], held_out.overrides)
                runs += _seeds(config, composed, folder / place / delay / name, task, overrides)
    by_folder = {run.folder: run.config for run in runs}
    for run in runs:
        if run.config.checkpoint is not None:
            with named(_place(run.folder.parent)):
                check_policy_fits(run.config, by_folder[Path(run.config.checkpoint)])
    succeeds = any(run.config.episode.can_succeed for run in runs)
    checks.require(
        succeeds or "success" not in config.score,
        "score",
        config.score,
        "is in none of the tasks anything that can be reached: choose return or perceived_return",
    )
    measured = all(config.score in (*BUILT_IN, *run.config.metrics) for run in runs)
    checks.require(
        measured,
        "score",
        config.score,
        f"is not measured by every run: add overrides=['metrics=[{config.score}]']",
    )
    return sorted(runs, key=lambda run: (run.stage, run.config.seed))


def _in(chosen: Sequence[str] | None, name: str) -> bool:
    return chosen is None or name in chosen


def _place(folder: Path) -> str:
    """Task, delay and method of a folder."""
    return "/".join(folder.parts[-3:])


def _replaced(words: Sequence[str], by: Sequence[str]) -> list[str]:
    """Words without those that others replace, and the others: ``delay=paper`` replaces
    ``delay.obs=4``."""
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
    method = config.experiment.methods[name]
    methods = config.experiment.methods
    away = task != trained_in  # a held-out task, where nothing is trained
    flown = method.policy_of or (name if away and not method.flies else None)
    trains = not (method.flies or flown)
    words = ["logger=csv", *overrides, *method.overrides, *config.overrides]
    with named(_place(folder)):
        unseeded = composed(*words)
        late_by = [] if method.delayed else late(unseeded.make_delays())
        if late_by and away:
            return  # a held-out delay, under which the undelayed method is not flown
        checks.require(
            not late_by,
            ", ".join(late_by),
            "its value",
            "delays this method, with which others are compared: put delays under experiment.delays",
        )
        if trains:
            able = not method.teacher or hasattr(unseeded.learner, "teacher")
            checks.require(able, "learner", unseeded.learner.name, "has no setting teacher")
            check_learning(unseeded)
    source = flown or method.source
    policy = None
    for seed in config.every_seed:
        seeded = replace(unseeded, seed=seed, overrides=[*words, f"seed={seed}"])
        if source:
            source_delay = delay if methods[source].delayed else NOT_LATE
            policy = folder.parents[2] / trained_in / source_delay / source / f"seed_{seed}"
            if flown or method.starts_from:
                seeded = replace(seeded, checkpoint=str(policy))
            else:
                seeded = replace(seeded, learner=replace(seeded.learner, teacher=str(policy)))
        stage = int(source is not None) if trains else 2
        flies = {PLANNER: fly_planner, SCRIPT: fly_script}.get(method.flies or "", fly)
        yield Run(train if trains else flies, seeded, folder / f"seed_{seed}", policy, stage)


def includes(config: CompareConfig, rows: pd.DataFrame) -> "pd.Series[bool]":
    """Which rows of results are of a task, a delay, a method and a seed that are asked for."""
    tasks = [*config.chosen("tasks")]
    first = config.experiment.first_seed
    tasks += [
        f"{task}{HELD_OUT_MARK}{name}" for task in tasks for name in config.experiment.held_out
    ]
    delays = [NOT_LATE, *config.chosen("delays")]
    methods = [*config.chosen("methods")]
    asked = {"task": tasks, "delay": delays, "method": methods}
    last = math.inf if config.seeds is None else config.every_seed[-1]
    return rows[[*asked]].isin(asked).all(axis=1) & rows["seed"].between(first, last)


def report(config: CompareConfig, results: Results, missing: Sequence[str], folder: Path) -> None:
    """Write the tables and the figures."""
    comparison = Comparison(*results, config.experiment.methods, config.score)
    write_csv(folder / TABLE, comparison.table, unknown="")
    write_atomically(folder / MARKDOWN, markdown(comparison, _notes(config, results.rows, missing)))
    plot_curves(comparison, folder / CURVES)
    plot_scores(comparison, folder / FIGURE)


def _notes(config: CompareConfig, rows: pd.DataFrame, missing: Sequence[str]) -> list[str]:
    """Lines above the tables: the command, the number of seeds and episodes, what the columns
    mean."""
    seeds = rows["seed"]
    episodes = sorted(rows["episodes"].astype(int).unique())
    few = rows.groupby(RUN[:-1])["seed"].nunique().min() < SEEDS or episodes[0] < EPISODES
    return [
        *[f"**developing**: fewer than {SEEDS} seeds or {EPISODES} episodes"] * bool(few),
        f"`{cli.command()}`",
        f"{seeds.nunique()} seeds ({seeds.min()} to {seeds.max()}), "
        f"{' or '.join(map(str, episodes))} episodes each",
        "Mean over seeds [95 % interval: bootstrap over seeds, widened for few seeds; none below "
        f"{FEWEST}]; J: {config.score} of the sampled policy; perceived: as far as the server "
        "knew, "
        "else as it truly was; age in steps; backupdated: share of the rewards in training; n: "
        "seeds",
        "J_norm: 0 random, 1 undelayed; recovery: 0 the strongest naive method of the same track "
        "(late "
        "data, or simulator), 1 undelayed, not shown where "
        "the delay costs less than a tenth of undelayed - random; P > naive: probability that a "
        "run beats "
        "one of the strongest naive method, with its score interval; n compared: seeds that all "
        "have",
        *[f"missing: {', '.join(missing)}"] * bool(missing),
    ]


def compare(config: CompareConfig, folder: Path) -> None:
    """Carry out the runs of a comparison that are not finished, and report on them."""
    check_no_links(folder)
    has_rows = (folder / ROWS).exists()
    failed = []
    if (
        config.report_only
        and has_rows
        and not any((folder / each).exists() for each in config.experiment.tasks)
    ):
        kept = stored_results(folder, "hydra.run.dir")
        runs = []
    else:
        if config.report_only and config.seeds is None:  # all up to the last one with a run
            names = (path.name.removeprefix("seed_") for path in folder.glob("*/*/*/seed_*"))
            last = max((int(name) for name in names if name.isdecimal()), default=-1)
            config = replace(config, seeds=max(last - config.experiment.first_seed + 1, 0) or None)
        kept = stored_results(folder, "hydra.run.dir") if config.keep and has_rows else NO_RESULTS
        runs = _not_kept(plan(config, folder), kept)
    for run in runs:
        not_linked(run.folder, below=folder)
        run.check()
    try:
        if not config.report_only:
            failed = perform_all(runs, config.processes)
    except KeyboardInterrupt:
        end_interrupted("run the same command again to continue")
    for run in failed:
        print(f"failed: {run.name}; see {run.folder / LOG}", file=sys.stderr)
    done = [run for run in runs if run.finished]
    if failed and not done:
        sys.exit(1)
    results = results_of(done, config.chosen("methods"), kept)
    if done:
        for name, rows in zip((ROWS, POINTS), results, strict=True):
            write_csv(folder / name, rows)
    results = Results(*(rows[includes(config, rows)] for rows in results))
    if results.rows.empty:
        raise InputError(f"experiment: no run of it is finished in {folder}; leave out report_only")
    report(config, results, [run.name for run in runs if not run.finished], folder)
    print((folder / MARKDOWN).read_text(encoding="utf-8"))
    print(f"results: {cli.short(folder)}")
    if failed:
        sys.exit(1)


def _not_kept(runs: list[Run], kept: Results) -> list[Run]:
    """The runs without kept results, or with a folder, and those whose policies they need."""
    done = {*kept.rows[RUN].itertuples(index=False, name=None)}
    todo = [run for run in runs if tuple(names_of(run).values()) not in done or run.folder.exists()]
    needed = {run.needs for run in todo if not run.finished}
    needed |= {run.needs for run in runs if run.folder in needed}
    return [run for run in runs if run in todo or run.folder in needed]


@cli.program("compare")
def main(given: DictConfig) -> None:
    running = HydraConfig.get()
    folder = cli.short(Path(running.runtime.output_dir))
    config = cli.checked(given, running.overrides.task, "compare")
    with (
        nullcontext() if config.report_only else locked(folder)
    ):  # it may be reported on while it runs
        compare(config, folder)
