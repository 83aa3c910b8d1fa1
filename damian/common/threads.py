"""The threads that torch's operations use."""

import os
from collections.abc import Iterator
from contextlib import contextmanager


def available_cores() -> int:
    """Number of cores that this process may use; at most ``OMP_NUM_THREADS``, if the environment sets it."""
    affinity = getattr(os, "sched_getaffinity", None)  # not on every system
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return min(cores, int(limit)) if limit.isdigit() and int(limit) else cores


@contextmanager
def using_threads(number: int) -> Iterator[None]:
    """Let torch use this number of threads within the context."""
    import torch  # noqa: PLC0415 (settings are read without it)

    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)
