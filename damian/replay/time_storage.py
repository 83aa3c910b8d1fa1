"""A replay-buffer storage that keeps steps in order of time."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage


class TimeStorage(LazyTensorStorage):
    """Keeps the latest ``max_size`` = T times B steps of B worlds in order of time, [T, B].

    The writer must be a round robin (TorchRL's default), and all batches must have the same B
    worlds.
    """

    def __init__(self, max_size: int, **options: Any) -> None:
        super().__init__(max_size, ndim=2, **options)

    @property
    def steps(self) -> TensorDictBase:
        """All stored steps, [T, B], as a ring: ``latest`` gives their order in time."""
        return self._storage

    # Private names of TorchRL are used in this file only.

    @property
    def n_steps(self) -> int:
        """Number of stored steps, T."""
        return self._len_along_dim0 or 0

    def rows(self, index: Tensor) -> TensorDictBase:
        """The steps at these indices [K], [K, B]; an entry is copied when it is read."""
        return self.steps._get_sub_tensordict(index)

    def overwrite(self, index: Tensor, entries: Mapping[NestedKey, Tensor]) -> None:
        """Replace entries of the steps at these indices [K] by values [K, B, ...], by key."""
        for key, value in entries.items():
            self.steps.get(key)[index] = value
        self._bump_mutation_revision()

    def latest(self, n_steps: int | None = None) -> Tensor:
        """Indices of the latest ``n_steps`` steps (all if not given) in order of time,
        [min(n_steps, T)]."""
        stored = self.n_steps
        n_steps = stored if n_steps is None else min(n_steps, stored)
        last = self._last or 0  # nothing is stored if there is none
        return torch.arange(last - n_steps + 1, last + 1, device=self.device) % max(stored, 1)

    @property
    def _last(self) -> int | None:
        """Index of the latest step."""
        last = self._last_cursor
        return None if last is None else int(torch.as_tensor(last).view(-1)[-1])

    # TorchRL saves the steps, but not which of them is the latest.

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "last": self._last}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict)
        self._last_cursor = state_dict["last"]

    def dumps(self, path: Any) -> None:
        raise NotImplementedError(
            "the files do not tell which step is the latest: save state_dict()"
        )
