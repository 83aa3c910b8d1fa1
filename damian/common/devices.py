"""What depends on the device."""

import ctypes
import sys

import torch


def data_dependent(device: torch.device) -> bool:
    """Whether shapes and branches may depend on data, so that only the rows that need it are worked
    on.

    Any device but a CPU would first have to finish all work to tell how many: there a mask chooses.
    """
    return device.type == "cpu"


def keep_freed_memory() -> None:
    """Let the C library of Linux keep freed memory for new tensors, of up to 32 MiB: it allows no
    more.

    The system would clear every page that it hands out again, which takes a tenth of a training's
    time.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(-1, 2**31 - 1)  # M_TRIM_THRESHOLD of malloc.h: the most that is kept
        mallopt(-3, 2**25)  # M_MMAP_THRESHOLD: what is larger is not kept
