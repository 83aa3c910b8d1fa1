"""Many runs, several at a time: each in a folder of its own, with what it prints in log.txt there.

What is finished is not run again, and what has a checkpoint goes on, so that Ctrl-C costs little.
"""

import csv
import multiprocessing
import os
import signal
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from tqdm import tqdm

from damian.common.errors import InputError
from damian.evaluation.run_folder import CHECKPOINT, CONFIG, RESULTS
from shared.composition_errors import one_line
from shared.launch import Program, perform, stored_config
from shared.settings import TrainConfig

LOG = "log.txt"
_SPAWN = multiprocessing.get_context("spawn")
_stop = _SPAWN.Event()
"""Set: begin nothing more. A worker has that of the process which began it."""


@dataclass(frozen=True)
class Run:
    """One arm and seed."""

    task: str
    delay: str
    arm: str
    config: TrainConfig
    folder: Path
    program: Program
    """``train``, or ``fly`` for an arm that evaluates the policy of another one; importable by name."""
    trains: bool
    """Does the program train, so that it leaves checkpoints and can be resumed."""

    @property
    def name(self) -> str:
        return "/".join(self.folder.parts[-4:])

    @property
    def finished(self) -> bool:
        return (self.folder / RESULTS).exists()

    def score(self, policy: str, measure: str) -> float:
        """One number of a finished run."""
        return next(row[measure] for row in self.results() if row["policy"] == policy)

    def results(self) -> list[dict[str, Any]]:
        """A row for each policy."""
        file = self.folder / RESULTS
        try:
            with file.open(newline="") as lines:
                return [
                    {"policy": row.pop("policy"), **{name: float(x) for name, x in row.items()}}
                    for row in csv.DictReader(lines)
                ]
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{file}: no results of a run ({one_line(error)}); delete the folder") from error


def check_stored(run: Run) -> None:
    """Refuse a folder that holds a run of another configuration; a setting that it lacks has its default."""
    if not (run.folder / CONFIG).exists():
        return
    try:
        stored = stored_config(run.folder, "hydra.run.dir")
    except InputError as error:
        raise InputError(f"{error}; delete the folder") from error
    asked = OmegaConf.create(OmegaConf.to_yaml(OmegaConf.structured(run.config)))
    known, wanted = (dict(_leaves(OmegaConf.to_container(config))) for config in (stored, asked))
    for key in wanted | known:
        own = key in ("resume", "overrides") or (key == "checkpoint" and not run.trains)
        if not own and known.get(key) != wanted.get(key):
            raise InputError(
                f"{run.folder}: {key} is {known.get(key)} in this stored run, and {wanted.get(key)} is asked "
                "for: delete the folder, or choose another one with hydra.run.dir"
            )


def _leaves(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(node, dict) and node:
        for key, value in node.items():
            yield from _leaves(value, f"{path}.{key}" if path else key)
    else:
        yield path, node


def perform_all(runs: Sequence[Run], processes: int, told: tuple[str, str]) -> list[Run]:
    """Carry out what is not finished; returns what has failed.

    Args:
        runs: what flies the policy of another one comes after it.
        processes: at the same time.
        told: policy and measure that the progress bar shows of the latest run.

    Raises:
        KeyboardInterrupt: after Ctrl-C, when every run has written a checkpoint.
    """
    todo, failed = [run for run in runs if not run.finished], []
    ended = _in_turn(todo) if processes == 1 else _at_once(todo, processes)
    with tqdm(total=len(runs), initial=len(runs) - len(todo), unit=" runs", disable=not todo) as bar:
        for run, error in ended:
            bar.update()
            if error:
                failed.append(run)
            else:
                bar.set_postfix_str(f"{run.name}: {run.score(*told):.3g}")
    return failed


def _in_turn(runs: Sequence[Run]) -> Iterator[tuple[Run, BaseException | None]]:
    """Carry runs out in this process; yields each with what went wrong."""
    for run in runs:
        try:
            _perform(run)
        except Exception as error:
            yield run, error
        else:
            yield run, None


def _at_once(runs: Sequence[Run], processes: int) -> Iterator[tuple[Run, BaseException | None]]:
    """Carry runs out in so many other processes; yields each, when it is over, with what went wrong."""
    _stop.clear()
    for trains in (True, False):  # a pool each: one whose worker was killed takes nothing more
        now = [run for run in runs if run.trains == trains]
        if now:
            yield from _in_pool(now, processes)


def _in_pool(runs: Sequence[Run], processes: int) -> Iterator[tuple[Run, BaseException | None]]:
    with ProcessPoolExecutor(processes, _SPAWN, _begin, (_stop,)) as pool:
        try:
            futures = _submit(pool, runs)
            for future in as_completed(futures):
                error = future.exception()
                if isinstance(error, KeyboardInterrupt):  # it has heard it sooner
                    raise error
                yield futures[future], error
        except KeyboardInterrupt:
            _stop.set()
            for worker in multiprocessing.active_children():  # a terminal has told them, ``kill`` has not
                os.kill(worker.pid or 0, signal.SIGINT)
            pool.shutdown(cancel_futures=True)
            raise


def _submit(pool: ProcessPoolExecutor, runs: Sequence[Run]) -> dict[Future[None], Run]:
    """Hand runs over to workers that are born deaf to Ctrl-C: only a training run listens to it."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        return {pool.submit(_perform, run): run for run in runs}
    finally:
        signal.signal(signal.SIGINT, before)


def _begin(stop: Event) -> None:
    """Of a worker: share the main process's wish to stop."""
    global _stop  # noqa: PLW0603 (a worker has no other place for it)
    _stop = stop


def _perform(run: Run) -> None:
    """Train, or fly the policy of another run."""
    if _stop.is_set():
        raise KeyboardInterrupt
    run.folder.mkdir(parents=True, exist_ok=True)
    with (run.folder / LOG).open("a", buffering=1) as log, redirect_stdout(log), redirect_stderr(log):
        try:
            begun = run.trains and (run.folder / CHECKPOINT).exists()
            config = replace(run.config, resume=str(run.folder)) if begun else run.config
            perform(config, run.folder, run.program)
        except SystemExit as interrupted:
            raise KeyboardInterrupt from interrupted
        except InputError as error:
            print(f"error: {error}")
            raise
        except BaseException:
            traceback.print_exc()
            raise
