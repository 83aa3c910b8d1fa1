"""Check the runs of a method of delaybench, and write them as the one file of a submission.

python docs/leaderboard.py runs/MYCOMPARISON mine "A. Author, B. Author"

The runs come from `damian compare` with the experiment delaybench, or one of your own that begins
with it (docs/delaybench.md). What is submitted is the true return that damian's own evaluation has
found.
"""

import hashlib
import json
import shlex
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
from torch import Tensor

from damian.common import checks
from damian.common.fields import leaves
from damian.common.tables import write_csv
from damian.compare.comparison import HELD_OUT_MARK, LATE_DATA, RUN, SIMULATOR, TRAINED
from damian.compare.config import EPISODES, Experiment
from damian.recipes import cli
from damian.recipes.config import TrainConfig
from damian.recipes.known import key_of
from damian.recipes.shared.runs import changed_settings
from damian.recipes.shared.sweeps import stored_results
from damian.runs.checkpoint import read_checkpoint
from damian.runs.run_folder import CHECKPOINT, RESULTS, read_results
from damian.runs.run_record import read_record

NUMBERS = ["frames", "episodes", "return"]
WORDS = [
    "task",
    "delay",
    "method",
    "authors",
    "regime",
    "fingerprint",
    "damian",
    "commit",
    "settings",
]
COLUMNS = [*RUN, *NUMBERS, "parameters", *WORDS[3:]]
"""Columns of a submission, which has a row for each run; ``settings`` are those of ``damian
train``."""
OLDER = "older"
"""The fingerprint of rows that were measured before tasks had one."""
FEWEST_SEEDS = 5
_NAMES = (
    "agents region motion wind source requests battery reward episode clock links randomise frames"
)
OF_TASKS = tuple(
    f"{name}." for name in f"{_NAMES} delay.obs delay.act delay.rew delay.loss".split()
)
"""How the keys of settings begin that a task and its delay state, and no method changes."""


def delaybench() -> Experiment:
    """The experiment delaybench."""
    return cli.settings("experiment=delaybench", program="compare").experiment


def submission(folder: Path, method: str, authors: str, experiment: Experiment) -> pd.DataFrame:
    """The rows of a method in the folder of a comparison, beside what their run folders tell."""
    rows = stored_results(folder).rows
    checks.one_of("method", method, [*rows["method"].unique()])
    rows = rows[(rows["method"] == method) & (rows["policy"] == TRAINED)].reset_index(drop=True)
    words = words_of_tasks(experiment)
    facts = list[dict[str, object]]()
    trained = dict[tuple[str, str], Path]()
    for task, delay, _, seed in rows[RUN].itertuples(index=False, name=None):
        run = folder / task / delay / method / f"seed_{seed}"
        record = read_record(run)
        should = "is not the folder of a finished run: keep those of all runs"
        checks.require((run / RESULTS).exists() and bool(record), "folder", run, should)
        found = read_results(run / RESULTS).set_index("policy")[
            "return"
        ]  # of damian's own evaluation
        settings = [
            word for word in record.get("overrides", []) if key_of(word) not in ("logger", "seed")
        ]
        told = {name: record.get(name) for name in ("damian", "commit")}
        learnt = words.get((trained_in(task), delay))
        told["fingerprint"] = fingerprint(*learnt) if learnt else None
        if learnt and task == trained_in(task):
            check_task(run, settings_of(*learnt))
        facts.append({"return": found[TRAINED], "settings": shlex.join(settings), **told})
        if (run / CHECKPOINT).exists():  # flights elsewhere have no networks
            trained[task, delay] = run  # those of all seeds have the same sizes
    known = rows.drop(columns=["return"]).join(pd.DataFrame(facts))
    size = max(map(parameters, trained.values()), default=0)
    return known.assign(authors=authors, parameters=size)[COLUMNS]


def words_of_tasks(experiment: Experiment) -> dict[tuple[str, str], list[str]]:
    """The settings of each task under each delay."""
    tasks = experiment.tasks
    delays = experiment.delays
    return {(task, delay): [*tasks[task], *delays[delay]] for task in tasks for delay in delays}


def trained_in(task: str) -> str:
    """The task in which a policy learnt that flies in a task, which may be held out."""
    return task.partition(HELD_OUT_MARK)[0]


settings_of = cache(cli.settings)
"""The settings of a training that words compose."""


@cache
def fingerprint(*words: str) -> str:
    """A hash, of twelve hexadecimal digits, of all settings of a task and its delay that ``words``
    compose; it changes with any of them."""
    stated = [leaf for leaf in leaves(settings_of(*words)) if f"{leaf[0]}.".startswith(OF_TASKS)]
    return hashlib.sha256(json.dumps(stated).encode()).hexdigest()[:12]


def check_task(run: Path, asked_for: TrainConfig) -> None:
    """Require that a run was in the task, under the delay, and for the steps that these settings
    state."""
    for key, found, asked in changed_settings(asked_for, run, "folder"):
        of_task = f"{key}.".startswith(OF_TASKS)
        checks.require(not of_task, f"{run}: {key}", found, f"is not {asked}, as the task has it")


def parameters(run: Path) -> int:
    """Number of parameters of the networks that a run has trained."""
    networks = read_checkpoint(run / CHECKPOINT, "folder").get("components", {})
    return sum(_count(part) for name, part in networks.items() if "optimizer" not in name)


def _count(value: object) -> int:
    if isinstance(value, Tensor):
        return value.numel()
    return sum(map(_count, value.values())) if isinstance(value, dict) else 0


def check_submission(rows: pd.DataFrame, experiment: Experiment, path: str) -> None:
    """Check a submission: its columns, places, seeds, episodes, numbers and words.

    Raises:
        InputError: the first thing that is wrong, and what would be right.
    """
    missing = [name for name in COLUMNS if name not in rows]
    checks.require(not missing, path, missing, f"are missing; the columns are {', '.join(COLUMNS)}")
    checks.require(len(rows) > 0, path, "it", "has no rows")
    places = [*experiment.tasks]
    places += [
        f"{task}{HELD_OUT_MARK}{name}" for task in experiment.tasks for name in experiment.held_out
    ]
    for task in rows["task"].unique():
        remedy = f'train in one that is, by experiment=delaybench "tasks=[{places[0]}]"'
        should = f"is not of the leaderboard: {remedy}"
        checks.require(task in places, f"{path}: task", task, should)
    for name, known in (("delay", experiment.delays), ("regime", (LATE_DATA, SIMULATOR))):
        for value in rows[name].unique():
            checks.one_of(f"{path}: {name}", value, [*known])
    for name in ("method", "regime", "damian"):
        values = [*rows[name].unique()]
        checks.require(len(values) == 1, f"{path}: {name}", values, "is not one for all rows")
    for name in WORDS:
        empty = rows[name].isna() | (rows[name].astype(str).str.strip() == "")
        should = "is empty"
        if name == "commit":
            should += ": train in a clone, with `pip install -e .` or `make train`"
        checks.require(not empty.any(), f"{path}: {name}", "it", should)
    words = words_of_tasks(experiment)
    for (task, delay), found in rows.groupby(["task", "delay"])["fingerprint"]:
        asked = fingerprint(*words[trained_in(task), delay])
        should = f"is not {asked}, that of the task as it stands: run it again"
        known = found.isin([asked, OLDER]).all()
        checks.require(known, f"{path}: {task}/{delay}: fingerprint", found.iloc[0], should)
    changed = rows["commit"].astype(str).str.contains("+", regex=False)
    should = "was a clone with changed files: commit them, then train again in a new folder"
    checks.require(not changed.any(), f"{path}: commit", rows["commit"].iloc[0], should)
    finite = np.isfinite(rows[[*NUMBERS, "parameters"]].to_numpy(float)).all()
    checks.require(bool(finite), path, "a number", "is not finite")
    for place, runs in rows.groupby(RUN[:-1], sort=False):
        where = f"{path}: {'/'.join(map(str, place))}"
        seeds = runs["seed"]
        checks.require(
            not seeds.duplicated().any(), f"{where}: seed", [*seeds], "are not all different"
        )
        enough = len(seeds) >= FEWEST_SEEDS and seeds.min() >= experiment.first_seed
        few = f"are too few, or too small: run compare again with keep=true seeds={FEWEST_SEEDS}"
        checks.require(
            bool(enough), f"{where}: seed", [*seeds], f"{few}, from {experiment.first_seed} on"
        )
        checks.in_range(f"{where}: episodes", int(runs["episodes"].min()), EPISODES)


def main() -> None:
    """Check a submission, and write its file."""
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    with cli.one_line_errors("compare"):
        folder, method, authors = sys.argv[1:]
        experiment = delaybench()
        rows = submission(Path(folder), method, authors, experiment)
        check_submission(rows, experiment, folder)
        path = Path(f"{method}.csv")
        write_csv(path, rows)
        print(
            f"{path}: {len(rows)} runs; move it to docs/results/leaderboard, and run "
            "python docs/leaderboard_pages.py"
        )


if __name__ == "__main__":
    main()
