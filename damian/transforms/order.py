"""A check of the order of transforms, from what each one does with which keys."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

from tensordict import NestedKey
from torchrl.envs import Compose, Transform

from damian.common.errors import InputError


class KeyUsage(NamedTuple):
    """What a transform does with which keys; this decides which of two transforms must come first."""

    reads: Sequence[NestedKey] = ()
    """Entries that it reads from the environment's outputs."""
    creates: Sequence[NestedKey] = ()
    """Entries that it creates, or overwrites regardless of their values."""
    delays: Sequence[NestedKey] = ()
    """Entries whose values it delays or holds."""
    appends: Sequence[NestedKey] = ()
    """Entries to which it appends values that the actor knows without delay."""
    replaces: Sequence[NestedKey] = ()
    """Actions that it replaces before they reach the environment."""
    records: Sequence[NestedKey] = ()
    """Actions that it records as the policy chose them."""


def check_order(transforms: Sequence[Transform]) -> None:
    """Refuse an order in which one transform undoes or misses the effect of another.

    Only transforms with a ``key_usage`` are compared.

    Args:
        transforms: transforms in the order in which they process the environment's outputs.

    Raises:
        InputError: two transforms are in the wrong order; the message names them and the key.
    """
    declared: list[tuple[Transform, KeyUsage]] = [
        (transform, cast(Any, transform).key_usage)
        for transform in transforms
        if _declares_key_usage(transform)
    ]
    for (first, a), (second, b) in itertools.combinations(declared, 2):
        name = type(second).__name__
        for key in _common_keys([*a.reads, *a.delays, *a.appends], b.creates):
            raise _wrong_order(first, second, f"it uses {key}, which {name} creates")
        for key in _common_keys(a.records, b.replaces):
            why = f"it must record {key} as chosen, and actions pass the transforms in reverse order"
            raise _wrong_order(first, second, why)
        for key in _common_keys(a.appends, b.delays):
            raise _wrong_order(first, second, f"{name} must not delay what it appends to {key}")


def leaf_transforms(compose: Compose) -> list[Any]:
    """All transforms of a Compose and of the Composes within it, in order."""
    return [leaf for t in compose for leaf in (leaf_transforms(t) if isinstance(t, Compose) else [t])]


def _declares_key_usage(transform: Transform) -> bool:
    return isinstance(getattr(type(transform), "key_usage", None), property)


def _wrong_order(first: Transform, second: Transform, why: str) -> InputError:
    names = type(first).__name__, type(second).__name__
    return InputError(f"order of transforms: {names[0]} must come after {names[1]}, because {why}")


def _common_keys(some: Sequence[NestedKey], others: Sequence[NestedKey]) -> list[NestedKey]:
    return [key for key in some if key in others]
