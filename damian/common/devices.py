"""What depends on the device."""

import math
from pathlib import Path

import torch


def data_dependent(device: torch.device) -> bool:
    """Whether shapes and branches may depend on data, so that only the rows that need it are worked on.

    Any device but a CPU would first have to finish all work to tell how many: there a mask chooses.
    """
    return device.type == "cpu"


def free_memory(device: torch.device) -> float:
    """Free memory of a device [GiB]; infinite where the system does not tell."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0] / 2**30
    table = Path("/proc/meminfo")  # of Linux: the memory that is free, or would be if it were asked for [KiB]
    lines = table.read_text(encoding="ascii").splitlines() if table.exists() else []
    free = [int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    return free[0] / 2**20 if free else math.inf
