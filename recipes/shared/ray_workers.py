"""Workers of a training on a Ray cluster, or on a Ray of this machine alone, through TorchRL's collector."""

import importlib.util
import os
import random
import re
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, NamedTuple, cast

import torch
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from damian.common.errors import InputError
from damian.common.threads import available_cores

START_LIMIT = 300
"""Seconds after which a Ray cluster that has no room for the workers is given up."""
ANSWER_LIMIT = 20
"""Seconds in which a worker answers, unless it is collecting."""
_ENDLESS = 2**62
"""Environment steps that no run reaches; ``RayCollector`` collects nothing if it is told -1."""


class WorkerPlan(NamedTuple):
    """What workers collect, wherever they are."""

    makers: Sequence[Callable[[], EnvBase]]
    """Makes the environment of each worker, in its process."""
    actor: torch.nn.Module
    """The actor whose weights the workers get before each batch."""
    frames: int
    """Environment steps of a batch, over all workers."""
    collector: type[Collector]
    """Class of a worker's collector."""
    compiled: dict[str, Any] | None
    """Options of the compiled actor, or None."""


def check_installed(key: str) -> None:
    """Check that Ray can be imported.

    Args:
        key: the setting that asks for Ray.

    Raises:
        InputError: it is not installed.
    """
    if importlib.util.find_spec("ray") is None:
        raise InputError(f"{key}: ray is not installed; pip install 'damian[ray]'")


def connected_ray(processes: int) -> tuple[Any, bool]:
    """The module ``ray``, connected to a cluster, and whether this call has connected it.

    The cluster is that of the environment variable ``RAY_ADDRESS`` (``auto``: the one to which ``ray start``
    has added this machine). Without it, a Ray with at least ``processes`` CPUs is started for this program
    only, and ends with it.

    Raises:
        InputError: there is no cluster at ``RAY_ADDRESS``.
    """
    # Ray counts its use and sends the numbers away unless it is told not to.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray = import_module("ray")

    if ray.is_initialized():
        return ray, False
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address := os.environ.get("RAY_ADDRESS"):
        try:
            ray.init(address=address, **quiet)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise InputError(f"RAY_ADDRESS: {address}: no Ray cluster answers there") from error
    else:
        os.environ.setdefault("RAY_AUTH_MODE", "disabled")  # only this machine can reach it
        os.environ.setdefault("RAY_worker_niceness", "0")  # else every other program goes before them
        cpus = max(processes, available_cores())
        ray.init(address="local", num_cpus=cpus, include_dashboard=False, **quiet)
    return ray, True


class RayWorkers:
    """Workers as Ray actors with one CPU each.

    Args:
        plan: what they collect.

    Raises:
        InputError: Ray is not installed, or has had no room for ``START_LIMIT`` seconds.
    """

    def __init__(self, plan: WorkerPlan) -> None:
        check_installed("collector")
        state = random.getstate()  # Ray draws from Python's generator, of which the run has seeded this one
        self._ray, self._connected = connected_ray(len(plan.makers))
        from torchrl.collectors.distributed import RayCollector  # noqa: PLC0415 (needs Ray)

        self.batches = RayCollector(
            list(plan.makers),
            plan.actor,
            frames_per_batch=plan.frames,
            total_frames=_ENDLESS,
            sync=True,
            update_after_each_batch=True,
            collector_class=cast(Any, plan.collector),
            collector_kwargs={"auto_register_policy_transforms": True, "compile_policy": plan.compiled},
            remote_configs={"num_cpus": 1, "scheduling_strategy": self._places(len(plan.makers))},
        )
        self._workers = list(self.batches.remote_collectors)
        self.batches.update_policy_weights_(plan.actor)
        random.setstate(state)

    def _places(self, number: int) -> Any:
        """Room for ``number`` workers in the cluster, all at once."""
        group = import_module("ray.util").placement_group([{"CPU": 1}] * number)
        try:
            self._ray.get(group.ready(), timeout=START_LIMIT)
        except self._ray.exceptions.GetTimeoutError:
            free, all_of = (
                int(found().get("CPU", 0))
                for found in (self._ray.available_resources, self._ray.cluster_resources)
            )
            self._ray.shutdown()
            should = f"have found no room on Ray for {START_LIMIT} s: {free} of its {all_of} CPUs are free"
            raise InputError(f"workers: {number} {should}; choose fewer, or a larger cluster") from None
        strategies = import_module("ray.util.scheduling_strategies")
        return strategies.PlacementGroupSchedulingStrategy(placement_group=group)

    def lost(self) -> tuple[int, str] | None:
        """The worker whose end has caused an error, and how it ended; None if all are there.

        What sends the weights has errors of its own, so that every worker is asked whether it lives. After an
        error, TorchRL ends all others by ``ray.kill``.
        """
        for number, worker in enumerate(self._workers):
            try:
                self._ray.get(worker.process_id.remote(), timeout=ANSWER_LIMIT)
            except self._ray.exceptions.GetTimeoutError:
                continue  # it is busy
            except self._ray.exceptions.RayActorError as end:
                if "ray.kill" not in str(end):
                    exit_type = re.search(r"Worker exit type: (\w+)", str(end))
                    return number, f"Ray says {exit_type[1] if exit_type else 'that it has died'}"
        return None

    def shutdown(self) -> None:
        """End all workers, and the connection to Ray."""
        self.batches.shutdown()
        if self._connected:
            self._ray.shutdown()
