"""Where the runs of a comparison are carried out, beside processes of this machine: Ray tasks, Slurm jobs."""

from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import Any

from damian.common.errors import InputError

from .composition_errors import one_line
from .ray_workers import check_installed, connected_ray

LAUNCHERS = ("local", "ray", "slurm")
STOP_LIMIT = 120
"""Seconds that interrupted Ray tasks have to write their checkpoints."""


class RayTasks(Executor):
    """Carries out functions as Ray tasks with one CPU each (``connected_ray`` says where).

    Args:
        processes: number of tasks at the same time for which a Ray of this machine has room.

    Raises:
        InputError: Ray is not installed.
    """

    def __init__(self, processes: int) -> None:
        check_installed("launcher")
        (self._ray, _), self._tasks = connected_ray(processes), []

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Carry out a function that can be imported by name."""
        task = self._ray.remote(num_cpus=1, max_retries=0)(fn).remote(*args, **kwargs)
        self._tasks.append(task)
        return task.future()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for the tasks; ``cancel_futures`` interrupts them as Ctrl-C, so that trainings are saved."""
        if not self._ray.is_initialized():
            return
        if cancel_futures:
            for task in self._tasks:
                self._ray.cancel(task)
        if self._tasks:
            limit = STOP_LIMIT if cancel_futures else None
            self._ray.wait(self._tasks, num_returns=len(self._tasks), timeout=limit)
        self._ray.shutdown()


class SlurmJobs(Executor):
    """Carries out functions as Slurm jobs, through submitit.

    Args:
        processes: number of jobs at the same time.
        folder: gets the files of submitit; all machines must see it.
        parameters: of submitit's executor; ``cluster: local`` starts processes of this machine instead.

    Raises:
        InputError: submitit is not installed, knows no such parameter, or finds no Slurm here.
    """

    def __init__(self, processes: int, folder: Path, parameters: Mapping[str, Any]) -> None:
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
            raise InputError(f"slurm: {one_line(error)}") from error
        self._threads, self._jobs = ThreadPoolExecutor(processes), []

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Carry out a function that can be imported by name."""
        return self._threads.submit(self._result, fn, *args, **kwargs)

    def _result(self, fn: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        job = self._executor.submit(fn, *args, **kwargs)
        self._jobs.append(job)
        return job.result()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for the jobs; ``cancel_futures`` cancels them with a signal that lets trainings be saved."""
        if cancel_futures:
            for job in self._jobs:
                job.cancel()
        self._threads.shutdown(wait, cancel_futures=cancel_futures)
