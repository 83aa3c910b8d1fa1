"""Rows of the entries that only specs describe, in environments whose batch may be chosen at a reset.

The batch of such an environment (``batch_locked`` is false, as in TorchRL's ``PendulumEnv``) is that of the
TensorDict with which it is reset; its specs lack these leading dimensions.
"""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from damian.common import checks
from damian.transforms.entries import as_rows, require_keys, row_shape, spec_rows


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


def require_one_level(
    transform: str, keys: Sequence[NestedKey], outputs: TensorDictBase, env: EnvBase
) -> None:
    """Require that the TensorDicts of some entries and actions have one batch size.

    Args:
        transform: name of the transform, for errors.
        keys: of entries of the outputs, and of actions.
        outputs: outputs of a reset.
        env: environment that has the specs of the actions.

    Raises:
        InputError: two of them have different batch sizes, or there is no such entry or action.
    """
    present, shapes = set(outputs.keys(True, True)), []
    for key in keys:
        if key in present:
            shapes.append(row_shape(outputs, key))
        else:
            require_keys(transform, [key], env.full_action_spec)
            in_specs = spec_rows(env.full_action_spec, key)
            shapes.append(rows_of_batch(outputs.batch_size, env, in_specs))
        first, other = list(shapes[0]), list(shapes[-1])
        should = f"have the batch sizes {first} and {other}: use one transform for each level"
        checks.require(first == other, transform, f"{keys[0]} and {key}", should)
