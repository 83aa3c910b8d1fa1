"""Runs in processes, and how a signal ends them: a training after its current update, many runs at
once."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from itertools import islice
from types import FrameType
from typing import Any, NoReturn, TypeVar

from damian.common.errors import RunError

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Ctrl-C, and what batch systems and ``kill`` send."""


class Interrupt:
    """Context in which the first Ctrl-C or SIGTERM only sets ``asked``; a second one ends the run
    at once."""

    asked: int | None = None
    """Number of the signal that asked to stop."""

    def __enter__(self) -> "Interrupt":
        self._before: dict[int, Any] = {
            number: signal.signal(number, self._ask) for number in SIGNALS
        }
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)

    def _ask(self, number: int, _: FrameType | None) -> None:
        self.asked = number
        self.__exit__()


def end_interrupted(remedy: str = "", number: int = signal.SIGINT) -> NoReturn:
    """End a program that a signal has stopped, with the exit code of shells: 130 or 143."""
    print(f"interrupted; {remedy}" if remedy else "interrupted", file=sys.stderr)
    sys.exit(128 + number)


R = TypeVar("R")


def each_in_processes(
    perform: Callable[[R], None], runs: Sequence[R], processes: int
) -> Iterator[R]:
    """Perform runs, and yield each that has ended.

    After Ctrl-C or SIGTERM it raises ``KeyboardInterrupt``, when every training has written a
    checkpoint.
    """
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)  # batch systems send it
    try:
        if processes > 1:
            yield from _in_pool(perform, runs, processes)
        else:
            for run in runs:
                perform(run)
                yield run
    except BrokenExecutor as error:
        raise RunError(
            "a worker process was killed; the same command continues all runs"
        ) from error
    finally:
        signal.signal(signal.SIGTERM, before)


def _in_pool(perform: Callable[[R], None], runs: Sequence[R], processes: int) -> Iterator[R]:
    waiting = iter(runs)
    futures = dict[Future[None], R]()
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), _begin) as pool:
        try:
            while True:
                for run in islice(
                    waiting, processes - len(futures)
                ):  # none waits in a worker's queue
                    futures[pool.submit(perform, run)] = run
                if not futures:
                    return
                for future in wait(futures, return_when=FIRST_COMPLETED).done:
                    future.result()
                    yield futures.pop(future)
        except KeyboardInterrupt:
            for (
                worker
            ) in multiprocessing.active_children():  # a signal to this process alone reaches none
                os.kill(worker.pid or 0, signal.SIGINT)
            raise


def _begin() -> None:
    """Initialise a worker: only a training handles Ctrl-C, and a worker ends with its main
    process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    if parent := multiprocessing.parent_process():
        parent.join()
        os._exit(1)
