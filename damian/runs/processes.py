"""Many runs, several at a time, each in a process of its own, which a signal stops as it stops this one."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from itertools import islice
from typing import TypeVar

from damian.common.errors import RunError
from damian.runs.interrupt import interrupt

R = TypeVar("R")


def each_in_processes(
    perform: Callable[[R], None], runs: Iterable[R], processes: int
) -> Iterator[tuple[R, BaseException | None]]:
    """Perform runs, taken one by one as processes become free; yields each with its error, or None.

    After Ctrl-C or SIGTERM it raises ``KeyboardInterrupt``, when every training has written a checkpoint.
    """
    before = signal.signal(signal.SIGTERM, interrupt)  # batch systems send it
    try:
        if processes > 1:
            yield from _in_pool(perform, runs, processes)
        else:
            for run in runs:
                try:
                    perform(run)
                except Exception as error:
                    yield run, error
                else:
                    yield run, None
    except BrokenExecutor as error:
        raise RunError("a worker process was killed; the same command continues all runs") from error
    finally:
        signal.signal(signal.SIGTERM, before)


def _in_pool(
    perform: Callable[[R], None], runs: Iterable[R], processes: int
) -> Iterator[tuple[R, BaseException | None]]:
    waiting, futures = iter(runs), dict[Future[None], R]()
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), _begin) as pool:
        try:
            while True:
                for run in islice(waiting, processes - len(futures)):
                    futures[pool.submit(perform, run)] = run
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
