"""Check the runs of a method of delaybench, and write them as the one file of a submission.

damian submit folder=runs/MYCOMPARISON method=mine "authors=A. Author, B. Author"

The runs come from `damian compare` with the experiment delaybench, or one of your own that begins
with it (docs/delaybench.md). What is submitted is the true return that damian's own evaluation has
found.
"""

import shlex
from functools import cache
from pathlib import Path

import pandas as pd
from omegaconf import DictConfig
from torch import Tensor

from damian.common import checks
from damian.common.tables import write_csv
from damian.compare.comparison import RUN, TRAINED
from damian.compare.config import Experiment
from damian.compare.leaderboard import COLUMNS, check_submission
from damian.runs.checkpoint import read_checkpoint
from damian.runs.run_folder import CHECKPOINT, RESULTS, read_results
from damian.runs.run_record import read_record

from . import cli
from .config import SubmitConfig, TrainConfig
from .known import key_of
from .shared.runs import changed_settings
from .shared.sweeps import stored_results

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
    composed = cache(cli.settings)  # the same for all runs of a task
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
        facts.append({"return": found[TRAINED], "settings": shlex.join(settings), **told})
        if (task, delay) in words:
            check_task(run, composed(*words[task, delay]))
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


def submit(config: SubmitConfig) -> None:
    """Check a submission, and write its file."""
    experiment = delaybench()
    rows = submission(Path(config.folder), config.method, config.authors, experiment)
    check_submission(rows, experiment, config.folder)
    path = Path(f"{config.method}.csv")
    write_csv(path, rows)
    print(
        f"{path}: {len(rows)} runs; add it to docs/results/leaderboard, and your files to "
        "examples/extending"
    )


@cli.program("submit")
def main(given: DictConfig) -> None:
    submit(cli.checked(given, [], "submit"))
