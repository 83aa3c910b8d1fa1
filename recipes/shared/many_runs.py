"""Carry out many runs, several at a time, each in its own folder with its output in log.txt.

Finished runs are not repeated, and interrupted ones continue from their checkpoints.
"""

import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from damian.common.errors import InputError, RunError
from damian.common.fields import leaves
from damian.runs.checkpoint import digest
from damian.runs.interrupt import interrupt
from damian.runs.run_folder import CHECKPOINT, CONFIG, RESULTS, read_results
from damian.runs.run_lock import locked
from damian.runs.run_record import read_record

from ..cli import Work
from ..config import TrainConfig
from .runs import POLICY, perform, stored_values

LOG = "log.txt"


@dataclass(frozen=True)
class Run:
    """One seed of an arm, for one task and delay."""

    task: str
    delay: str
    arm: str
    config: TrainConfig
    folder: Path
    program: Work
    """The work to do, importable by name."""
    trains: bool = True
    """Does the program train, so that it writes checkpoints and can be resumed?"""
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
        """Has the run results, and if it flies another's policy, are they of that policy as it is now?"""
        has_results = (self.folder / RESULTS).exists()
        if self.needs is None or not has_results or self.config.checkpoint is None:
            return has_results
        same = read_record(self.folder).get(POLICY) == digest(self.needs / CHECKPOINT)
        return same and (self.needs / RESULTS).exists()

    def score(self, policy: str, measure: str) -> float:
        """A measure of one policy in the results of a finished run, or of its first one."""
        values = read_results(self.folder / RESULTS).set_index("policy")[measure]
        return float(values.get(policy, values.iloc[0]))


def check_stored(run: Run) -> None:
    """Check that a run folder is empty or holds a run with the same settings."""
    if not (run.folder / CONFIG).exists():
        return
    try:
        stored = stored_values(run.folder, "hydra.run.dir")
    except InputError as error:
        raise InputError(f"{error}; delete the folder") from error
    for key, new in leaves(run.config):
        old: Any = stored
        for name in key.split("."):
            old = old.get(name) if isinstance(old, dict) else None
        if old != new and key not in ("resume", "overrides", "checkpoint", "learner.teacher"):
            raise InputError(
                f"{run.folder}: {key} is {old} in this stored run, and {new} is asked "
                "for: delete the folder, or choose another one with hydra.run.dir"
            )


def perform_all(
    runs: Sequence[Run], processes: int, told: tuple[str, str], done: Callable[[Run], None]
) -> list[Run]:
    """Carry out the runs that are not finished, and call ``done`` after each; returns those that failed.

    The bar shows the measure ``told`` (policy and name) of the run that finished last.
    """
    todo, failed = [run for run in runs if not run.finished], []
    with tqdm(total=len(runs), initial=len(runs) - len(todo), unit=" runs", disable=not todo) as bar:
        for stage in range(3):
            for run, error in perform_each([r for r in todo if r.stage == stage], processes):
                bar.update()
                if error:
                    failed.append(run)
                else:
                    bar.set_postfix_str(f"{run.name}: {run.score(*told):.3g}")
                    done(run)
    return failed


def perform_each(runs: Iterable[Run], processes: int) -> Iterator[tuple[Run, BaseException | None]]:
    """Carry out runs, taken one by one as processes become free; yields each with its error, or None.

    After Ctrl-C or SIGTERM it raises ``KeyboardInterrupt``, when every training has written a checkpoint.
    """
    before = signal.signal(signal.SIGTERM, interrupt)  # batch systems send it
    try:
        if processes > 1:
            yield from _in_pool(runs, processes)
        else:
            for run in runs:
                try:
                    perform_run(run)
                except Exception as error:
                    yield run, error
                else:
                    yield run, None
    except BrokenExecutor as error:
        raise RunError("a worker process was killed; the same command continues all runs") from error
    finally:
        signal.signal(signal.SIGTERM, before)


def _in_pool(runs: Iterable[Run], processes: int) -> Iterator[tuple[Run, BaseException | None]]:
    waiting, futures = iter(runs), dict[Future[None], Run]()
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), _begin) as pool:
        try:
            while True:
                for run in islice(waiting, processes - len(futures)):
                    futures[pool.submit(perform_run, run)] = run
                if not futures:
                    return
                for future in wait(futures, return_when=FIRST_COMPLETED).done:
                    error = future.exception()
                    if isinstance(error, KeyboardInterrupt | BrokenExecutor):
                        raise error
                    yield futures.pop(future), error
        except KeyboardInterrupt:
            _interrupt_workers()
            raise


def _interrupt_workers() -> None:
    """Stop trainings in workers, which a signal to this process alone does not reach."""
    for worker in multiprocessing.active_children():
        os.kill(worker.pid or 0, signal.SIGINT)


def _begin() -> None:
    """Initialise a worker: only a training handles Ctrl-C, and a worker ends with its main process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    if parent := multiprocessing.parent_process():
        parent.join()
        os._exit(1)


def perform_run(run: Run) -> None:
    """Carry out one run, resuming it if it has a checkpoint."""
    run.folder.mkdir(parents=True, exist_ok=True)
    with (
        (run.folder / LOG).open("a", encoding="utf-8", buffering=1) as log,
        redirect_stdout(log),
        redirect_stderr(log),
    ):
        try:
            if run.needs is not None and not (run.needs / RESULTS).exists():
                raise InputError(f"checkpoint: {run.needs} has no finished policy")
            with locked(run.folder):
                resumes = run.trains and (run.folder / CHECKPOINT).exists()
                config = replace(run.config, resume=str(run.folder)) if resumes else run.config
                perform(config, run.folder, run.program)
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
