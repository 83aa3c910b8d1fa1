"""Runs of the programs that compare with published tables: arms and seeds, each with its result in a file."""

import json
import multiprocessing
import re
import tempfile
from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from tqdm import tqdm

from damian.common import checks
from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError
from damian.common.text_files import named, read_text, show

from .command_line import Parser


class OutsideRun(Protocol):
    """One arm with one seed: a ``NamedTuple`` of the settings that its result depends on."""

    @property
    def arm(self) -> str: ...

    @property
    def seed(self) -> int: ...

    def _asdict(self) -> dict[str, Any]: ...


def add_options(parser: Parser, arms: Sequence[str], folder: str) -> None:
    """Add the options that all of these programs have."""
    parser.add_argument("--arms", default=",".join(arms), help="arms (ways to learn), all or some of these")
    parser.add_argument("--seeds", default="0,1,2", help="seeds of each arm")
    parser.add_argument("--out", type=Path, default=Path(folder), help="run folder")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes, each with one thread")


def chosen_runs(args: Namespace, arms: Sequence[str]) -> list[tuple[str, int]]:
    """The arm and the seed of each run that the options ask for.

    Raises:
        InputError: an arm is not known, a seed is no number, or one is named twice.
    """
    chosen, seeds = args.arms.split(","), args.seeds.split(",")
    valid = {*chosen} <= {*arms} and len({*chosen}) == len(chosen)
    checks.require(valid, "--arms", args.arms, f"is not a list of different ones of {','.join(arms)}")
    valid = all(re.fullmatch(r"[0-9]{1,9}", seed) for seed in seeds)
    valid = valid and len({*map(int, seeds)}) == len(seeds)
    checks.require(valid, "--seeds", args.seeds, "is not a list of different whole numbers such as 0,1,2")
    checks.in_range("--jobs", args.jobs, 1, 1024)
    return [(arm, int(seed)) for seed in seeds for arm in chosen]


def make_folder(folder: Path) -> None:
    """Make the run folder.

    Raises:
        InputError: it cannot be made or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, ValueError) as error:
        raise InputError(f"--out: {folder}: {getattr(error, 'strerror', error)}") from None


def run_all(
    runs: Sequence[Any],
    folder: Path,
    jobs: int,
    run_arm: Callable[[Any, Path, int], None],
    is_good: Callable[[Any], bool],
) -> None:
    """Carry out the runs without a result, in ``jobs`` processes.

    Args:
        runs: each an ``OutsideRun``.
        folder: the run folder; it is made.
        jobs: number of processes.
        run_arm: carries out one run; its last argument is the line of its progress bar. Importable by name.
        is_good: whether something can be the returns of a run.

    Raises:
        InputError: the folder cannot be written to, or holds something else than results of these runs.
    """
    make_folder(folder)
    check_results(runs, folder, is_good)
    todo = [run for run in runs if not file_of(run, folder).exists()]
    work = [(run, folder, place) for place, run in enumerate(todo)]
    if jobs == 1:
        for arguments in work:
            run_arm(*arguments)
        return
    spawn = multiprocessing.get_context("spawn")
    tqdm.set_lock(spawn.RLock())
    with spawn.Pool(jobs, initializer=tqdm.set_lock, initargs=(tqdm.get_lock(),)) as pool:
        pool.starmap(run_arm, work, chunksize=1)


def file_of(run: OutsideRun, folder: Path) -> Path:
    """The file with the result of a run."""
    return folder / f"seed{run.seed}_{run.arm}.json"


def save_result(run: OutsideRun, folder: Path, returns: dict[str, Any]) -> None:
    """Write the returns of a run.

    Raises:
        RunError: the file cannot be written, such as on a full disk.
    """
    write_atomically(file_of(run, folder), json.dumps({**run._asdict(), "returns": returns}))


def check_results(runs: Sequence[OutsideRun], folder: Path, is_good: Callable[[Any], bool]) -> None:
    """Check the results that the folder holds already.

    Args:
        runs: that are asked for.
        folder: the run folder.
        is_good: whether something can be the returns of a run.

    Raises:
        InputError: a file holds something else, or a result with other settings.
    """
    for run in runs:
        if (file := file_of(run, folder)).exists():
            saved = read_result(run, folder, is_good)
            for name, value in run._asdict().items():
                should = f"is not the {saved[name]} of {file}; choose another folder with --out"
                checks.require(saved[name] == value, f"--{name}", value, should)


def read_result(run: OutsideRun, folder: Path, is_good: Callable[[Any], bool]) -> dict[str, Any]:
    """The settings of a finished run, and its ``returns``.

    Raises:
        InputError: its file holds something else.
    """
    file = file_of(run, folder)
    with named(file):
        try:
            saved = json.loads(read_text(file))
        except (ValueError, RecursionError) as error:
            raise InputError(f"is not the result of a run ({type(error).__name__}); delete it") from None
        complete = isinstance(saved, dict) and {*run._asdict(), "returns"} <= {*saved}
        good = complete and is_good(saved["returns"])
        checks.require(good, "it", show(saved), "is not the result of a run; delete it")
    return saved
