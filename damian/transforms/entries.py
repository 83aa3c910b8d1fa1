"""Entries of TensorDicts, viewed as M rows: one for each world, or for each agent of each world."""

from collections.abc import Iterable, Sequence
from typing import cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded

from damian.common.errors import InputError
from damian.common.tensors import expand_mask
from damian.common.text_files import listed
from damian.keys import last_part

Entries = dict[NestedKey, Tensor]
"""Entries of a TensorDict, by key."""
Keys = NestedKey | Sequence[NestedKey]
"""A key, or several."""


def path_of(key: NestedKey) -> tuple[str, ...]:
    """The path of the TensorDict that directly contains an entry."""
    return cast(tuple[str, ...], key[:-1]) if isinstance(key, tuple) else ()


def spec_rows(specs: Composite, key: NestedKey) -> torch.Size:
    """The shape of the specs that directly contain that of an entry."""
    path = path_of(key)
    return (specs[path] if path else specs).shape


def as_rows(value: Tensor, rows: torch.Size) -> Tensor:
    """Reshape an entry [*rows, ...] to [M, ...], where M is the number of rows."""
    return value.reshape(rows.numel(), *value.shape[len(rows) :])


def select_entries(tensordict: TensorDictBase, keys: Sequence[NestedKey]) -> Entries:
    """The entries with these keys, as far as they exist, without their autograd graph."""
    found = {}
    for key in keys:
        value = tensordict.get(key, None)
        if value is not None:
            found[key] = value.detach() if value.requires_grad else value
    return found


def sibling_key(key: NestedKey, name: NestedKey | None) -> NestedKey | None:
    """The key of the bare ``name`` beside the entry ``key``; a nested key, or None, is returned as
    it is."""
    if name is None or not isinstance(name, str) or isinstance(key, str):
        return name
    return (*key[:-1], name)


def existing(keys: Iterable[NestedKey | None]) -> list[NestedKey]:
    """The keys that are not None."""
    return [key for key in keys if key is not None]


def add_spec(
    specs: Composite,
    key: NestedKey | None,
    shape: Sequence[int],
    dtype: torch.dtype = torch.float32,
) -> None:
    """Add the spec of an entry without bounds; nothing if the key is None."""
    if key is not None:
        size = torch.Size(shape)
        kind = Binary if dtype == torch.bool else Unbounded
        specs[key] = kind(shape=size, dtype=dtype, device=specs.device)


def require_keys(transform: str, keys: Sequence[NestedKey], present: Iterable[NestedKey]) -> None:
    """Require that the entries that a transform reads exist; else raise an ``InputError``."""
    known = list(present)
    missing = next((key for key in keys if key not in known), None)
    if missing is not None:
        raise InputError(
            f"{transform}: {missing} is not among the keys of the environment: "
            f"{listed(map(str, known))}"
        )


def flag_keys(name: str, key: NestedKey, present: Iterable[NestedKey]) -> list[NestedKey]:
    """The keys among ``present`` of the flags of this name that apply to an entry, the outermost
    first.

    These are the flags in the TensorDict of the entry and in those around it; if there are none,
    all flags within the innermost TensorDict around the entry that contains any: TorchRL aggregates
    flags in this way.
    """
    path = path_of(key)
    flags = [flag for flag in present if last_part(flag) == name]
    around = [flag for flag in flags if path[: len(path_of(flag))] == path_of(flag)]
    if around:
        return sorted(around, key=lambda flag: len(path_of(flag)))
    within = (
        [f for f in flags if path_of(f)[:depth] == path[:depth]]
        for depth in range(len(path), -1, -1)
    )
    return next((found for found in within if found), [])


def reset_rows(tensordict: TensorDictBase, key: NestedKey, rows: torch.Size) -> Tensor | None:
    """The rows that are reset, [M] bool, by the outermost flag ``_reset``; None if there is
    none."""
    keys = flag_keys("_reset", key, list(tensordict.keys(True, True)))
    if not keys:
        return None
    around = path_of(key)[: len(path_of(keys[0]))] == path_of(keys[0])
    return any_flag([tensordict.get(flag) for flag in (keys[:1] if around else keys)], rows)


def any_flag(flags: Sequence[Tensor], rows: torch.Size) -> Tensor:
    """Whether any of some flags of worlds [*B, 1], or of their agents [*B, N, 1], is true for a
    row, [M]."""
    found = torch.zeros(rows, dtype=torch.bool, device=flags[0].device)
    for flag in flags:
        shape = flag.shape[:-1]
        if len(shape) > len(rows):
            found = found | flag.flatten(len(rows)).any(-1)
        else:
            found = found | expand_mask(flag.squeeze(-1), found)
    return found.reshape(-1)
