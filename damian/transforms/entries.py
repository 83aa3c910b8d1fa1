"""Entries of TensorDicts, viewed as M rows: one for each world, or for each agent of each world."""

from collections.abc import Mapping, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from damian.common import checks
from damian.common.text_files import listed

Memory = dict[str, Tensor]
"""The memory of a transform: its buffers by name."""

Entries = dict[NestedKey, Tensor]
"""Entries of a TensorDict, by key."""

Change = tuple[Memory, Entries]
"""The new memory of a transform, and the entries that it writes."""


def row_shape(tensordict: TensorDictBase, key: NestedKey) -> torch.Size:
    """The batch size of the TensorDict that directly contains an entry."""
    inner = tensordict.get(key[:-1]) if isinstance(key, tuple) and len(key) > 1 else tensordict
    return inner.batch_size


def spec_rows(specs: Composite, key: NestedKey) -> torch.Size:
    """As ``row_shape``, but read from specs."""
    return (specs[key[:-1]] if isinstance(key, tuple) and len(key) > 1 else specs).shape


def as_rows(value: Tensor, rows: torch.Size) -> Tensor:
    """Reshape an entry [*rows, ...] to [M, ...], where M is the number of rows."""
    return value.reshape(rows.numel(), *value.shape[len(rows) :])


def from_rows(value: Tensor, rows: torch.Size) -> Tensor:
    """Reshape [M, ...] to an entry [*rows, ...]."""
    return value.view((*rows, *value.shape[1:]))


def select_entries(tensordict: TensorDictBase, keys: Sequence[NestedKey]) -> Entries:
    """The entries with these keys, as far as they exist, detached from the autograd graph."""
    found = {key: tensordict.get(key, None) for key in keys}
    return {key: value.detach() for key, value in found.items() if value is not None}


def require_keys(transform: str, keys: Sequence[NestedKey], present: TensorDictBase | Composite) -> None:
    """Require that the entries that a transform reads exist.

    Args:
        transform: name of the transform, for errors.
        keys: of the entries.
        present: the outputs of a reset, or specs.

    Raises:
        InputError: one is missing.
    """
    known = list(present.keys(True, True))
    for key in keys:
        should = f"is not among the keys of the environment: {listed(map(str, known))}"
        checks.require(key in known, transform, key, should)


def flag_rows(
    tensordict: TensorDictBase | Mapping[NestedKey, Tensor], name: str, key: NestedKey, rows: torch.Size
) -> Tensor | None:
    """The flag ``name``, such as ``_reset`` or ``done``, that applies to the rows of an entry, [M] bool.

    TensorDicts may contain the flag at several levels: the one nearest to the entry applies.

    Args:
        tensordict: contains the flag.
        name: name of the flag.
        key: key of the entry.
        rows: shape of the entry's rows.

    Returns:
        The flag of each row, or None if there is no such flag.
    """
    for flag_key in flag_keys(name, key):
        flag = tensordict.get(flag_key, None)
        if flag is not None:
            flag = flag.any(-1)
            return flag.view((*flag.shape, *[1] * (len(rows) - flag.dim()))).expand(rows).reshape(-1)
    return None


def flag_keys(name: str, key: NestedKey) -> list[NestedKey]:
    """The keys under which a flag that applies to an entry may be found, the nearest to the entry first."""
    path = key[:-1] if isinstance(key, tuple) else ()
    return [(*path[:depth], name) for depth in range(len(path), 0, -1)] + [name]


def sibling_key(key: NestedKey, name: NestedKey | None) -> NestedKey | None:
    """The key of an entry in the same TensorDict as another entry.

    Args:
        key: key of the other entry, such as ``("agents", "observation")``.
        name: bare name, such as ``age``, which gives ``("agents", "age")``. A nested key, or None, is
            returned as it is.
    """
    if name is None or not isinstance(name, str) or isinstance(key, str):
        return name
    return (*key[:-1], name)


def drop_keys(entries: Entries, keys: Sequence[NestedKey]) -> Entries:
    """The entries without those of these keys."""
    return {key: value for key, value in entries.items() if key not in keys}
