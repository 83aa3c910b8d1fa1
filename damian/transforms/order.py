"""What transforms do with keys, and the orders of transforms that cannot work."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

from tensordict import NestedKey
from torchrl.envs import Compose, Transform

from damian.common.errors import InputError


class KeyUsage(NamedTuple):
    """What a transform does with keys, which decides which of two transforms must come first."""

    reads: Sequence[NestedKey] = ()
    """Entries that it reads from the environment's outputs."""
    creates: Sequence[NestedKey] = ()
    """Entries that it writes from scratch, whatever was there."""
    delays: Sequence[NestedKey] = ()
    """Entries that it holds back for some time."""
    appends: Sequence[NestedKey] = ()
    """Entries to which it appends what the actor knows without any message."""
    replaces: Sequence[NestedKey] = ()
    """Actions that it replaces before they reach the environment."""
    records: Sequence[NestedKey] = ()
    """Actions that it records as they were chosen."""


def check_order(transforms: Sequence[Transform]) -> None:
    """Refuse an order in which one transform undoes or misses another's work.

    Only transforms that declare a ``key_usage`` are compared.

    Raises:
        InputError: names the two, the key, and which must come first.
    """
    declared: list[tuple[Transform, KeyUsage]] = [
        (transform, cast(Any, transform).key_usage) for transform in transforms if _declares(transform)
    ]
    for (early, a), (late, b) in itertools.combinations(declared, 2):
        for key in _both([*a.reads, *a.delays, *a.appends], b.creates):
            raise _wrong(late, early, f"{key} is made there and used here")
        for key in _both(a.records, b.replaces):
            raise _wrong(late, early, f"{key} must be recorded as it was chosen")
        for key in _both(a.appends, b.delays):
            raise _wrong(late, early, f"what it appends to {key} is known at once, not held back")


def leaf_transforms(compose: Compose) -> list[Any]:
    """The transforms of nested Composes, in order."""
    return [leaf for t in compose for leaf in (leaf_transforms(t) if isinstance(t, Compose) else [t])]


def _declares(transform: Transform) -> bool:
    return isinstance(getattr(type(transform), "key_usage", None), property)


def _wrong(first: Transform, second: Transform, why: str) -> InputError:
    names = type(second).__name__, type(first).__name__
    return InputError(f"order of transforms: {names[0]} must come after {names[1]}, as {why}")


def _both(some: Sequence[NestedKey], others: Sequence[NestedKey]) -> list[NestedKey]:
    return [key for key in some if key in others]
