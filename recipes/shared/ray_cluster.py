"""The connection to Ray, for the workers of a training and for the runs of a comparison."""

import importlib.util
import os
from importlib import import_module
from typing import Any

from damian.common.errors import InputError
from damian.common.threads import available_cores


def connected_ray(key: str, processes: int) -> tuple[Any, bool]:
    """The module ``ray``, connected to a cluster, and whether this call has connected it.

    The cluster is that of the environment variable ``RAY_ADDRESS`` (``auto``: the one to which ``ray start``
    has added this machine). Without it, a Ray with at least ``processes`` CPUs is started for this program
    only, and ends with it.

    Args:
        key: the setting that asks for Ray.
        processes: number of tasks or actors at the same time.

    Raises:
        InputError: Ray is not installed or does not start, or there is no cluster at ``RAY_ADDRESS``.
    """
    if importlib.util.find_spec("ray") is None:
        raise InputError(f"{key}: ray is not installed; pip install 'damian[ray]'")
    # Ray counts its use and sends the numbers away unless it is told not to.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray = import_module("ray")
    if ray.is_initialized():
        return ray, False
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    address = os.environ.get("RAY_ADDRESS")
    if address:
        options["address"] = address
    else:
        os.environ.setdefault("RAY_AUTH_MODE", "disabled")  # only this machine can reach it
        os.environ.setdefault("RAY_worker_niceness", "0")  # else every other program goes before them
        options |= {"address": "local", "include_dashboard": False}
        options["num_cpus"] = max(processes, available_cores())
    try:
        ray.init(**options)
    except Exception as error:  # Ray documents no common class of what it raises here
        if address:
            raise InputError(f"RAY_ADDRESS: {address}: no Ray cluster answers there") from error
        raise InputError(f"{key}: Ray does not start on this machine: {error}") from error
    return ray, True
