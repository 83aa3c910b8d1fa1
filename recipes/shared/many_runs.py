"""Carry out many runs, several at a time, each in its own folder with its output in log.txt.

Finished runs are not repeated, and interrupted ones continue from their checkpoints. The runs are carried out
in processes of this machine, as Ray tasks, or as Slurm jobs.
"""

import csv
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import islice
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, NoReturn

import torch
from tqdm import tqdm

from damian.common.errors import InputError, RunError
from damian.runs.checkpoint import digest
from damian.runs.interrupt import exit_code
from damian.runs.metrics import EVALUATED
from damian.runs.run_folder import CHECKPOINT, CONFIG, RESULTS
from damian.runs.run_lock import locked
from damian.runs.run_record import POLICY, read_record
from damian.settings import TrainConfig
from damian.settings.fields import leaves

from ..cli import Work, reason
from .ray_cluster import connected_ray
from .runs import perform, stored_config

LOG = "log.txt"
STOP_LIMIT = 120
"""Seconds that interrupted Ray tasks have to write their checkpoints."""
_SPAWN = multiprocessing.get_context("spawn")
_stop = _SPAWN.Event()
"""Set after Ctrl-C: no further run begins. Worker processes share the event of the main process."""
_idle = threading.Event()
"""Not set while this process carries out a run."""


class Stopped(KeyboardInterrupt):
    """A signal has stopped the runs; its only argument is the exit code."""


def stop_code(error: KeyboardInterrupt) -> int:
    """The exit code of a program whose runs were stopped: 130 after Ctrl-C, 143 after SIGTERM."""
    return error.args[0] if isinstance(error, Stopped) else exit_code(signal.SIGINT)


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

    @property
    def name(self) -> str:
        return "/".join(self.folder.parts[-4:])

    @property
    def policy(self) -> Path | None:
        """Folder of the run whose policy this one flies, if it flies another one's."""
        return None if self.config.checkpoint is None else Path(self.config.checkpoint)

    @property
    def finished(self) -> bool:
        """Has the run results, and if it flies another's policy, are they of that policy as it is now?"""
        if self.policy is None or not (self.folder / RESULTS).exists():
            return (self.folder / RESULTS).exists()
        same = read_record(self.folder).get(POLICY) == digest(self.policy / CHECKPOINT)
        return same and (self.policy / RESULTS).exists()

    def score(self, policy: str, measure: str) -> float:
        """A measure of one policy in the results of a finished run, or of its first one."""
        rows = {row["policy"]: row for row in self.results()}
        return rows.get(policy, next(iter(rows.values())))[measure]

    def results(self) -> list[dict[str, Any]]:
        """The results of a finished run, a row for each policy.

        Raises:
            InputError: the file does not hold the results of a run.
        """
        file = self.folder / RESULTS
        try:
            with file.open(newline="") as lines:
                rows = [
                    {"policy": row.pop("policy"), **{name: float(x) for name, x in row.items()}}
                    for row in csv.DictReader(lines)
                ]
            if missing := [name for name in EVALUATED if not rows or name not in rows[0]]:
                raise ValueError(f"no {missing[0]}")
            return rows
        except (KeyError, TypeError, ValueError) as error:
            problem = f"it does not hold the results of a run ({reason(error)})"
            raise InputError(f"{file}: {problem}; delete the folder") from error


def check_stored(run: Run) -> None:
    """Check that a run folder is empty or holds a run with the same settings.

    Raises:
        InputError: the stored settings differ or cannot be read.
    """
    if not (run.folder / CONFIG).exists():
        return
    try:
        stored = stored_config(run.folder, "hydra.run.dir", named=[repr(dict(leaves(run.config)))])
    except InputError as error:
        raise InputError(f"{error}; delete the folder") from error
    old, new = dict(leaves(stored)), dict(leaves(run.config))
    for key in new | old:
        if key == "checkpoint" and _same_run(old.get(key), new.get(key)):
            continue
        if key not in ("resume", "overrides") and old.get(key) != new.get(key):
            raise InputError(
                f"{run.folder}: {key} is {old.get(key)} in this stored run, and {new.get(key)} is asked "
                "for: delete the folder, or choose another one with hydra.run.dir"
            )


def _same_run(folder: str | None, other: str | None) -> bool:
    """Do two paths name the same delay, arm and seed, wherever their experiment lies?"""
    return folder is not None and other is not None and Path(folder).parts[-3:] == Path(other).parts[-3:]


# Where runs are carried out.


class RayTasks:
    """Carries out runs as Ray tasks with one CPU each (``connected_ray`` says where).

    Args:
        processes: number of tasks at the same time for which a Ray of this machine has room.

    Raises:
        InputError: Ray is not installed, or there is no cluster.
    """

    def __init__(self, processes: int) -> None:
        self._ray, _ = connected_ray("launcher", processes)  # which ends with this program
        self._tasks: list[Any] = []

    def carry_out(self, run: Run) -> None:
        """Carry out a run, and wait for its end."""
        self._tasks.append(self._ray.remote(num_cpus=1, max_retries=0)(perform_run).remote(run))
        self._ray.get(self._tasks[-1])

    def cancel(self) -> None:
        """Interrupt all runs as Ctrl-C, so that trainings write their checkpoints."""
        for task in self._tasks:
            self._ray.cancel(task)
        self._ray.wait(self._tasks, num_returns=len(self._tasks), timeout=STOP_LIMIT)


class SlurmJobs:
    """Carries out runs as Slurm jobs, through submitit.

    Args:
        folder: gets the files of submitit; all machines must see it.
        parameters: of submitit's executor; ``cluster: local`` starts processes of this machine instead.

    Raises:
        InputError: submitit is not installed, knows no such parameter, or finds no Slurm here.
    """

    def __init__(self, folder: Path, parameters: Mapping[str, Any]) -> None:
        try:
            submitit = import_module("submitit")
        except ImportError:
            problem = "submitit is not installed; pip install 'damian[cluster]'"
            raise InputError(f"launcher: {problem}") from None
        options = {"cpus_per_task": 1, "name": "damian", **parameters}
        try:
            self._executor = submitit.AutoExecutor(folder, cluster=options.pop("cluster", "slurm"))
            self._executor.update_parameters(**options)
        except (NameError, RuntimeError, TypeError, ValueError) as error:
            raise InputError(f"slurm: {reason(error)}") from error
        self._jobs: list[Any] = []

    def carry_out(self, run: Run) -> None:
        """Carry out a run, and wait for its end."""
        self._jobs.append(self._executor.submit(perform_run, run))
        self._jobs[-1].result()

    def cancel(self) -> None:
        """Cancel all jobs with a signal at which trainings write their checkpoints."""
        for job in self._jobs:
            job.cancel()


def perform_all(
    runs: Sequence[Run], processes: int, told: tuple[str, str], launcher: RayTasks | SlurmJobs | None = None
) -> list[Run]:
    """Carry out the runs that are not finished; returns those that failed.

    Args:
        runs: a run that flies the policy of another one must come after it.
        processes: number of runs at the same time.
        told: policy and measure of the latest run that the progress bar shows.
        launcher: for runs that are not carried out in processes of this machine.

    Raises:
        KeyboardInterrupt: after Ctrl-C or SIGTERM, when every training run has written a checkpoint.
    """
    todo, failed = [run for run in runs if not run.finished], []
    with tqdm(total=len(runs), initial=len(runs) - len(todo), unit=" runs", disable=not todo) as bar:
        for trains in (True, False):  # two pools, because a pool whose worker was killed accepts no more runs
            for run, error in perform_each([r for r in todo if r.trains == trains], processes, launcher):
                bar.update()
                if error:
                    failed.append(run)
                else:
                    bar.set_postfix_str(f"{run.name}: {run.score(*told):.3g}")
    return failed


def perform_each(
    runs: Iterable[Run], processes: int, launcher: RayTasks | SlurmJobs | None = None
) -> Iterator[tuple[Run, BaseException | None]]:
    """Carry out runs; yields each, when it has ended, with its error, or None.

    Args:
        runs: taken from an iterator one by one, as processes become free.
        processes: number of runs at the same time; a single one is this process.
        launcher: for runs that are not carried out in processes of this machine.

    Raises:
        KeyboardInterrupt: after Ctrl-C or SIGTERM, when every training run has written a checkpoint.
    """
    _stop.clear()
    with _stopped_by_sigterm():
        if launcher is not None:
            yield from _in_pool(runs, processes, ThreadPoolExecutor(processes), launcher)
        elif processes > 1:
            yield from _in_pool(runs, processes, ProcessPoolExecutor(processes, _SPAWN, _begin, (_stop,)))
        else:
            for run in runs:
                try:
                    perform_run(run)
                except Exception as error:
                    yield run, error
                else:
                    yield run, None


@contextmanager
def _stopped_by_sigterm() -> Iterator[None]:
    """Stop the runs inside at SIGTERM, which batch systems send, as at Ctrl-C."""

    def stop(number: int, _: object) -> NoReturn:
        raise Stopped(exit_code(number))

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _in_pool(
    runs: Iterable[Run], processes: int, pool: Executor, launcher: RayTasks | SlurmJobs | None = None
) -> Iterator[tuple[Run, BaseException | None]]:
    """Carry out runs with a pool: of worker processes, or of threads that wait for a launcher."""
    carry_out = launcher.carry_out if launcher else perform_run
    waiting, futures = iter(runs), dict[Future[None], Run]()
    with pool:
        try:
            while True:
                for run in islice(waiting, processes - len(futures)):
                    futures[_submitted(pool, carry_out, run)] = run
                if not futures:
                    return
                for future in wait(futures, return_when=FIRST_COMPLETED).done:
                    error = future.exception()
                    if isinstance(error, KeyboardInterrupt):  # the signal reached the worker first
                        raise error
                    yield futures.pop(future), error
        except KeyboardInterrupt:
            _stop.set()
            if launcher:
                launcher.cancel()
            # Ctrl-C in a terminal reaches the workers, but a signal sent to this process alone does not.
            for worker in multiprocessing.active_children():
                os.kill(worker.pid or 0, signal.SIGINT)
            pool.shutdown(cancel_futures=True)
            raise


def _submitted(pool: Executor, carry_out: Any, run: Run) -> Future[None]:
    """What becomes of a run; an error if a worker of the pool was killed before it could begin."""
    # A worker begins with Ctrl-C ignored: only a training handles it, and not while modules are imported.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        return pool.submit(carry_out, run)
    except BrokenExecutor as error:
        broken: Future[None] = Future()
        broken.set_exception(error)
        return broken
    finally:
        signal.signal(signal.SIGINT, before)


def _begin(stop: Event) -> None:
    """Initialise a worker process: it shares the stop event of the main process."""
    global _stop  # noqa: PLW0603 (the event cannot be passed to ``perform_run`` with a run)
    _stop = stop
    _idle.set()
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End a worker process whose main process was killed; a training writes its checkpoint before.

    Else it would go on with its run, whose folder it locks, and then wait for another one for ever.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)  # ends at once what does not handle it
        _idle.wait()
        os._exit(exit_code(signal.SIGTERM))


def perform_run(run: Run) -> None:
    """Carry out one run, resuming it if it has a checkpoint."""
    if _stop.is_set():
        raise KeyboardInterrupt
    _idle.clear()
    run.folder.mkdir(parents=True, exist_ok=True)
    with (run.folder / LOG).open("a", buffering=1) as log, redirect_stdout(log), redirect_stderr(log):
        try:
            if run.policy is not None and not (run.policy / RESULTS).exists():
                raise InputError(f"checkpoint: {run.policy} has no finished policy to fly")
            with locked(run.folder):
                resumes = run.trains and (run.folder / CHECKPOINT).exists()
                config = replace(run.config, resume=str(run.folder)) if resumes else run.config
                perform(config, run.folder, run.program)
        except SystemExit as interrupted:
            raise Stopped(interrupted.code) from interrupted
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
            _idle.set()
