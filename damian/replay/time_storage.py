"""A replay-buffer storage that keeps steps in order of time."""

from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage


class TimeStorage(LazyTensorStorage):
    """Keeps the latest steps of B worlds in order of time, [T, B].

    The writer must be a round robin (TorchRL's default), and all batches must have the same B worlds.

    Args:
        max_size: number of environment steps, T times B.
        options: of ``LazyTensorStorage``.
    """

    def __init__(self, max_size: int, **options: Any) -> None:
        super().__init__(max_size, ndim=2, **options)

    @property
    def steps(self) -> TensorDictBase:
        """All stored steps, [T, B], as a ring: ``latest`` gives their order in time."""
        return cast(TensorDictBase, self._storage)

    def latest(self, n_steps: int | None = None) -> Tensor:
        """Indices of the latest ``n_steps`` steps (all if not given) in order of time, [min(n_steps, T)]."""
        stored = cast(int, self._len_along_dim0)
        n_steps = stored if n_steps is None else min(n_steps, stored)
        last = int(torch.as_tensor(self._last_cursor).view(-1)[-1])
        return torch.arange(last - n_steps + 1, last + 1, device=self.device) % stored
