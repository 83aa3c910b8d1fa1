"""Rows of the entries that only specs describe, in environments whose batch may be chosen at a reset.

The batch of such an environment (``batch_locked`` is false, as in TorchRL's ``PendulumEnv``) is that of the
TensorDict with which it is reset; its specs lack these leading dimensions.
"""

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from damian.transforms.entries import as_rows


def rows_of_batch(batch: torch.Size, env: EnvBase, spec_rows: torch.Size) -> torch.Size:
    """The shape of the rows: the batch, then the dimensions that specs add to that of the environment.

    Args:
        batch: batch size of the outputs of a reset.
        env: environment that has the specs.
        spec_rows: shape of the rows as the specs tell it.
    """
    return torch.Size((*batch, *spec_rows[len(env.batch_size) :]))


def expand_to_rows(value: Tensor, spec_rows: torch.Size, rows: torch.Size) -> Tensor:
    """Repeat a value that was read from a spec for every world of the batch.

    Args:
        value: [*spec_rows, ...].
        spec_rows: shape of the rows as the specs tell it, the last dimensions of ``rows``.
        rows: shape of the rows, M in all.

    Returns:
        The value of each row, [M, ...], in memory of its own.
    """
    return as_rows(value.expand((*rows, *value.shape[len(spec_rows) :])), rows).clone()
