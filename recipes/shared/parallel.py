"""Carry out many runs, several at a time, each in its own folder with its output in log.txt.

Finished runs are not repeated, and interrupted ones continue from their checkpoints.
"""

import csv
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from tqdm import tqdm

from damian.common.errors import InputError, RunError
from damian.runs.checkpoint import digest
from damian.runs.interrupt import exit_code
from damian.runs.metrics import EVALUATED
from damian.runs.run_folder import CHECKPOINT, CONFIG, RESULTS
from damian.runs.run_lock import locked
from damian.runs.run_record import POLICY, read_record

from .composition_errors import one_line
from .launch import Program, perform
from .settings import TrainConfig
from .stored_runs import stored_config

LOG = "log.txt"
_SPAWN = multiprocessing.get_context("spawn")
_stop = _SPAWN.Event()
"""Set after Ctrl-C: no further run begins. Worker processes share the event of the main process."""
_idle = threading.Event()
"""Not set while this process carries out a run."""


@dataclass(frozen=True)
class Run:
    """One seed of an arm, for one task and delay."""

    task: str
    delay: str
    arm: str
    config: TrainConfig
    folder: Path
    program: Program
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
        """Has the run results, which belong to the finished policy that it flies, if it flies another's?"""
        results = self.folder / RESULTS
        if not results.exists() or self.policy is None:
            return results.exists()
        source = self.policy / RESULTS
        flown, stored = read_record(self.folder).get(POLICY), digest(self.policy / CHECKPOINT)
        if source.exists() and flown and stored:
            return flown == stored
        # An older damian did not record it. The times of copied files need not tell which was written first.
        return source.exists() and source.stat().st_mtime_ns <= results.stat().st_mtime_ns

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
            problem = f"it does not hold the results of a run ({one_line(error)})"
            raise InputError(f"{file}: {problem}; delete the folder") from error


def check_stored(run: Run) -> None:
    """Check that a run folder is empty or holds a run with the same settings; missing ones have defaults.

    Raises:
        InputError: the stored settings differ or cannot be read.
    """
    if not (run.folder / CONFIG).exists():
        return
    try:
        stored = stored_config(run.folder, "hydra.run.dir")
    except InputError as error:
        raise InputError(f"{error}; delete the folder") from error
    asked = OmegaConf.create(OmegaConf.to_yaml(OmegaConf.structured(run.config)))
    old, new = (dict(_leaves(OmegaConf.to_container(config))) for config in (stored, asked))
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


def _leaves(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every dotted key of nested dictionaries with its value."""
    if isinstance(node, dict) and node:
        for key, value in node.items():
            yield from _leaves(value, f"{path}.{key}" if path else key)
    else:
        yield path, node


Launcher = Callable[[], Executor]
"""Makes what carries out runs elsewhere (``recipes/shared/launchers.py``), several at the same time."""


def perform_all(
    runs: Sequence[Run], processes: int, told: tuple[str, str], launcher: Launcher | None = None
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
    runs: Iterable[Run], processes: int, launcher: Launcher | None = None
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
    with _sigterm_as_ctrl_c():
        if launcher is None and processes == 1:
            yield from _in_turn(runs)
        else:
            here = partial(ProcessPoolExecutor, processes, _SPAWN, _begin, (_stop,))
            yield from _in_pool(runs, processes, launcher or here)


@contextmanager
def _sigterm_as_ctrl_c() -> Iterator[None]:
    """Stop the runs inside at SIGTERM, which batch systems send, as at Ctrl-C."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _in_turn(runs: Iterable[Run]) -> Iterator[tuple[Run, BaseException | None]]:
    """Carry out runs in this process, one after the other."""
    for run in runs:
        try:
            _perform(run)
        except Exception as error:
            yield run, error
        else:
            yield run, None


def _in_pool(
    runs: Iterable[Run], processes: int, launcher: Launcher
) -> Iterator[tuple[Run, BaseException | None]]:
    """Carry out runs in worker processes."""
    waiting, futures = iter(runs), dict[Future[None], Run]()
    with launcher() as pool:
        try:
            while futures := futures | _submit(pool, islice(waiting, processes - len(futures))):
                for future in wait(futures, return_when=FIRST_COMPLETED).done:
                    error = future.exception()
                    if isinstance(error, KeyboardInterrupt):  # Ctrl-C reached the worker first
                        raise error
                    yield futures.pop(future), error
        except KeyboardInterrupt:
            _stop.set()
            # Ctrl-C in a terminal reaches the workers, but a signal sent to this process alone does not.
            for worker in multiprocessing.active_children():
                os.kill(worker.pid or 0, signal.SIGINT)
            pool.shutdown(cancel_futures=True)
            raise


def _submit(pool: Executor, runs: Iterable[Run]) -> dict[Future[None], Run]:
    """Submit runs to workers that start with Ctrl-C ignored: only a training run handles it."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        return {_submitted(pool, run): run for run in runs}
    finally:
        signal.signal(signal.SIGINT, before)


def _submitted(pool: Executor, run: Run) -> Future[None]:
    """What becomes of a run; an error if a worker of the pool was killed before it could begin."""
    try:
        return pool.submit(_perform, run)
    except BrokenProcessPool as error:
        broken: Future[None] = Future()
        broken.set_exception(error)
        return broken


def _begin(stop: Event) -> None:
    """Initialise a worker process: it shares the stop event of the main process."""
    global _stop  # noqa: PLW0603 (the event cannot be passed to ``_perform`` with a run)
    _stop = stop
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


def _perform(run: Run) -> None:
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
            raise KeyboardInterrupt from interrupted
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
