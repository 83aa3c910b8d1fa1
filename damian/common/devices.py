"""What depends on the device: whether the amount of work may depend on data, and copies of constants."""

import functools

import torch
from torch import Tensor


def data_dependent(device: torch.device) -> bool:
    """Whether shapes and branches may depend on data, so that only the rows that need it are worked on.

    Any device but a CPU would first have to finish all work to tell how many: there a mask chooses.
    """
    return device.type == "cpu"


def constant(numbers: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Numbers as a tensor [K], which is copied to a device only once; do not change it in place."""
    if torch.compiler.is_compiling():  # a graph contains its constants
        return torch.tensor(numbers, dtype=dtype, device=device)
    return _copied(numbers, dtype, device)


@functools.lru_cache(maxsize=64)
def _copied(numbers: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # else no gradient could flow through what is computed with it
        return torch.tensor(numbers, dtype=dtype, device=device)
