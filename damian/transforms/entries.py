"""Entries of TensorDicts, viewed as M rows: one for each world, or for each agent of each world."""

from collections.abc import Iterable, Sequence
from typing import cast

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Composite

from damian.common import checks
from damian.common.tensors import expand_mask
from damian.common.text_files import listed
from damian.keys import last_part

Memory = dict[str, Tensor]
"""The memory of a transform: its buffers by name."""

Entries = dict[NestedKey, Tensor]
"""Entries of a TensorDict, by key."""

Change = tuple[Memory, Entries]
"""The new memory of a transform, and the entries that it writes."""


def read_keys(written: NestedKey | Sequence[NestedKey]) -> list[NestedKey]:
    """Keys as TorchRL's transforms take them: a name or a tuple of names is one key, a list holds several.

    Raises:
        InputError: something is no key.
    """
    nested = isinstance(written, tuple) and all(isinstance(part, str) for part in written)
    one = isinstance(written, str) or (nested and bool(written))
    checks.require(one or isinstance(written, Iterable), "keys", repr(written), _NO_KEY)
    keys: list[NestedKey] = [written] if one else list(written)  # type: ignore[list-item]
    for key in keys:
        good = isinstance(key, str) or (isinstance(key, tuple) and _names(key))
        checks.require(bool(key) and good, "keys", repr(key), _NO_KEY)
    return [unravel_key(key) for key in keys]


def _names(key: tuple[object, ...]) -> bool:
    """Is a nested key made of names, at any depth, as ``unravel_key`` takes it?"""
    return all(isinstance(part, str) or (isinstance(part, tuple) and _names(part)) for part in key)


_NO_KEY = "is not a key such as 'observation' or ('agents', 'observation'), nor a list of keys"


def require_as_many(sent: Sequence[NestedKey], written: Sequence[NestedKey]) -> None:
    """Require one of ``out_keys`` for each entry that is sent."""
    should = f"are not {len(sent)} keys, as many as what is sent"
    checks.require(len(written) == len(sent), "out_keys", written, should)


def path_of(key: NestedKey) -> tuple[str, ...]:
    """The path of the TensorDict that directly contains an entry."""
    return cast(tuple[str, ...], key[:-1]) if isinstance(key, tuple) else ()


def row_shape(tensordict: TensorDictBase, key: NestedKey) -> torch.Size:
    """The batch size of the TensorDict that directly contains an entry."""
    path = path_of(key)
    return (tensordict.get(path) if path else tensordict).batch_size


def spec_rows(specs: Composite, key: NestedKey) -> torch.Size:
    """As ``row_shape``, but read from specs."""
    path = path_of(key)
    return (specs[path] if path else specs).shape


def as_rows(value: Tensor, rows: torch.Size) -> Tensor:
    """Reshape an entry [*rows, ...] to [M, ...], where M is the number of rows."""
    return value.reshape(rows.numel(), *value.shape[len(rows) :])


def from_rows(value: Tensor, rows: torch.Size) -> Tensor:
    """Reshape [M, ...] to an entry [*rows, ...]."""
    return value.view((*rows, *value.shape[1:]))


def select_entries(tensordict: TensorDictBase, keys: Sequence[NestedKey], gradients: bool = False) -> Entries:
    """The entries with these keys, as far as they exist, without their autograd graph unless it is wanted."""
    found = {key: tensordict.get(key, None) for key in keys}
    return {key: value if gradients else value.detach() for key, value in found.items() if value is not None}


def row_bytes(entries: Entries, n_rows: int) -> int:
    """Size of all entries together for each of so many rows [bytes]."""
    return sum(value.nbytes for value in entries.values()) // n_rows


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
        if isinstance(key, tuple) and all(part in known for part in key):
            should = f"is one nested key, which the environment lacks; two keys are written {list(key)}"
        checks.require(key in known, transform, key, should)


def require_new(transform: str, key: NestedKey, present: Iterable[NestedKey], remedy: str = "") -> None:
    """Require that an entry that a transform creates has a name of its own, as it would replace another.

    Args:
        transform: name of the transform, for errors.
        key: of the entry.
        present: keys of what there is already.
        remedy: what to say beside that another name is needed.

    Raises:
        InputError: there is such an entry already.
    """
    should = f"is already an entry of the environment: choose another name{remedy}"
    checks.require(unravel_key(key) not in present, transform, key, should)


def flag_keys(name: str, key: NestedKey, present: Iterable[NestedKey]) -> list[NestedKey]:
    """The keys of the flags that apply to an entry, such as ``done``, the outermost first.

    These are the flags in the TensorDict of the entry and in those that contain it. If there are none, they
    are all flags within the innermost TensorDict around the entry that contains any: a world is done, or is
    reset, if any of its agents is, as TorchRL aggregates flags.

    Args:
        name: name of the flag.
        key: key of the entry.
        present: all keys that exist.
    """
    path = path_of(key)
    flags = [flag for flag in present if last_part(flag) == name]
    around = [flag for flag in flags if path[: len(path_of(flag))] == path_of(flag)]
    if around:
        return sorted(around, key=lambda flag: len(path_of(flag)))
    within = ([f for f in flags if path_of(f)[:depth] == path[:depth]] for depth in range(len(path), -1, -1))
    return next((found for found in within if found), [])


def reset_rows(tensordict: TensorDictBase, key: NestedKey, rows: torch.Size) -> Tensor | None:
    """The rows of an entry that are reset, [M] bool, or None if the TensorDict does not say which.

    If there are flags ``_reset`` at several levels, the outermost one decides, as in TorchRL.
    """
    keys = flag_keys("_reset", key, list(tensordict.keys(True, True)))
    if not keys:
        return None
    around = path_of(key)[: len(path_of(keys[0]))] == path_of(keys[0])
    return any_flag([tensordict.get(flag) for flag in (keys[:1] if around else keys)], rows)


def any_flag(flags: Sequence[Tensor], rows: torch.Size) -> Tensor:
    """Whether any of some flags of worlds [*B, 1], or of their agents [*B, N, 1], is true for a row, [M]."""
    found = torch.zeros(rows, dtype=torch.bool, device=flags[0].device)
    for flag in flags:
        shape = flag.shape[:-1]
        if len(shape) > len(rows):
            found = found | flag.flatten(len(rows)).any(-1)
        else:
            found = found | expand_mask(flag.squeeze(-1), found)
    return found.reshape(-1)


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
