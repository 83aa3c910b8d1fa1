"""Entries of TensorDicts: as rows (one for each world, or for each agent of each world)."""

from collections.abc import Mapping, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

Memory = dict[str, Tensor]
"""Everything that a transform remembers, by the name of its buffer."""

Entries = dict[NestedKey, Tensor]
"""Entries of a TensorDict, by key."""

Change = tuple[Memory, Entries]
"""The new memory, and the entries to write."""


def row_shape(tensordict: TensorDictBase, key: NestedKey) -> torch.Size:
    """The batch size of the TensorDict in which an entry lies."""
    inner = tensordict.get(key[:-1]) if isinstance(key, tuple) and len(key) > 1 else tensordict
    return inner.batch_size


def spec_rows(specs: Composite, key: NestedKey) -> torch.Size:
    """The batch size of the TensorDict in which an entry lies, by its specs."""
    return (specs[key[:-1]] if isinstance(key, tuple) and len(key) > 1 else specs).shape


def as_rows(value: Tensor, rows: torch.Size) -> Tensor:
    """An entry [*rows, ...] as [M, ...]."""
    return value.reshape(rows.numel(), *value.shape[len(rows) :])


def from_rows(value: Tensor, rows: torch.Size) -> Tensor:
    """Rows [M, ...] as an entry [*rows, ...]."""
    return value.view((*rows, *value.shape[1:]))


def select_entries(tensordict: TensorDictBase, keys: Sequence[NestedKey]) -> Entries:
    """The entries under those of the keys that exist, detached from their gradients."""
    found = {key: tensordict.get(key, None) for key in keys}
    return {key: value.detach() for key, value in found.items() if value is not None}


def flag_rows(
    tensordict: TensorDictBase | Mapping[NestedKey, Tensor], name: str, key: NestedKey, rows: torch.Size
) -> Tensor | None:
    """The flag ``name`` (such as ``_reset`` or ``done``) that governs an entry, for each of its rows [M].

    The one nearest to the entry counts, from its own TensorDict outwards; None if there is none.
    """
    for flag_key in flag_keys(name, key):
        flag = tensordict.get(flag_key, None)
        if flag is not None:
            flag = flag.any(-1)
            return flag.view((*flag.shape, *[1] * (len(rows) - flag.dim()))).expand(rows).reshape(-1)
    return None


def flag_keys(name: str, key: NestedKey) -> list[NestedKey]:
    """Where a flag may stand that governs an entry, the nearest place first."""
    path = key[:-1] if isinstance(key, tuple) else ()
    return [(*path[:depth], name) for depth in range(len(path), 0, -1)] + [name]


def sibling_key(key: NestedKey, name: NestedKey | None) -> NestedKey | None:
    """A bare name as a key beside another one: ``age`` sibling_key ``("agents", "observation")``."""
    if name is None or not isinstance(name, str) or isinstance(key, str):
        return name
    return (*key[:-1], name)


def drop_keys(entries: Entries, keys: Sequence[NestedKey]) -> Entries:
    """The entries under all other keys."""
    return {key: value for key, value in entries.items() if key not in keys}
