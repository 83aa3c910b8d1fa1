"""A check of the order of transforms, from what each one does with which keys."""

import itertools
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

from tensordict import NestedKey
from torchrl.envs import (
    Compose,
    ConditionalPolicySwitch,
    ConditionalSkip,
    FrameSkipTransform,
    MultiAction,
    NoopResetEnv,
    RandomTruncationTransform,
    RewardSum,
    StepCounter,
    TerminateTransform,
    Transform,
)

from damian.common.errors import InputError
from damian.keys import ENDS, last_part

_STEPPING = (FrameSkipTransform, NoopResetEnv, MultiAction, ConditionalPolicySwitch)
"""TorchRL's transforms that step a copy of what comes before them in their environment."""


class KeyUsage(NamedTuple):
    """What a transform does with which keys; this decides which of two transforms must come first."""

    reads: Sequence[NestedKey] = ()
    """Entries that it reads from the environment's outputs."""
    creates: Sequence[NestedKey] = ()
    """Entries that it creates, under names that no other entry may have (``require_new``)."""
    overwrites: Sequence[NestedKey] = ()
    """Entries that it writes regardless of whether they exist, and of their values."""
    delays: Sequence[NestedKey] = ()
    """Entries whose values it delays or holds."""
    appends: Sequence[NestedKey] = ()
    """Entries to which it appends values that the actor knows without delay."""
    replaces: Sequence[NestedKey] = ()
    """Actions that it replaces before they reach the environment."""
    records: Sequence[NestedKey] = ()
    """Actions that it records as the policy chose them."""
    pays_at_end: bool = False
    """Whether it pays what is still in transit in the last step of an episode."""
    may_end: bool = False
    """Whether it may end episodes."""
    derives: Sequence[tuple[NestedKey, NestedKey]] = ()
    """Entries that it computes from others: pairs of the entry read and another one written."""
    ages: Sequence[tuple[NestedKey, NestedKey]] = ()
    """Entries whose age it tells: pairs of the entry and the age."""
    holds: Sequence[tuple[NestedKey, NestedKey | None]] = ()
    """Entries that it holds: pairs of the entry and of the age that it lets grow meanwhile, if any."""
    skips: bool = False
    """Whether it may keep worlds from stepping."""
    flags: Sequence[NestedKey] = ()
    """Flags that it writes for the environment, beside the actions."""


def check_order(transforms: Sequence[Transform]) -> None:
    """Refuse an order in which one transform undoes or misses the effect of another.

    Pairs of which neither is damian's are not looked at. What TorchRL's own transforms do is read from their
    keys. Where a wrong order may be meant, a warning is given.

    Args:
        transforms: transforms in the order in which they process the environment's outputs.

    Raises:
        InputError: two transforms are in the wrong order, or write the same flag for the environment; the
            message names them and the key.
    """
    usages = [(transform, _usage_of(transform)) for transform in transforms]
    for (first, a), (second, b) in itertools.combinations(usages, 2):
        if _declares_key_usage(first) or _declares_key_usage(second):
            _check_pair(first, a, second, b)


def check_stepping(transforms: Sequence[Transform]) -> None:
    """Refuse transforms that step a copy of damian's, which has no memory of the episode.

    Args:
        transforms: transforms of one environment, without those of an environment within it.

    Raises:
        InputError: one comes after a transform of damian; the message names both.
    """
    declaring = [transform for transform in transforms if _declares_key_usage(transform)]
    stepping = [transform for transform in transforms if isinstance(transform, _STEPPING)]
    if not (declaring and stepping):
        return
    first, last = declaring[0], stepping[-1]
    names = type(first).__name__, type(last).__name__
    if any(each is first for each in itertools.takewhile(lambda each: each is not last, transforms)):
        around = f"TransformedEnv(env, {names[1]}(...), auto_unwrap=False)"
        why = f"{names[1]} steps a copy of what comes before it, which has no memory; or around: {around}"
        raise _wrong_order(names, why)


def _check_pair(first: Transform, a: KeyUsage, second: Transform, b: KeyUsage) -> None:
    names = type(first).__name__, type(second).__name__
    for key in _common_keys([*a.reads, *a.delays, *a.appends], [*b.creates, *b.overwrites]):
        raise _wrong_order(names, f"it uses {key}, which {names[1]} creates")
    for key in _common_keys(a.records, b.replaces):
        why = f"it must record {key} as chosen, and actions pass the transforms in reverse order"
        raise _wrong_order(names, why)
    for key in _common_keys(a.appends, b.delays):
        raise _wrong_order(names, f"{names[1]} must not delay what it appends to {key}")
    if a.pays_at_end and b.may_end:
        raise _wrong_order(names, f"what is in transit when {names[1]} ends an episode would be lost")
    for key in _common_keys(a.flags, b.flags):
        raise InputError(f"{names[1]}: {key} is already the flag of another {names[0]}: choose another name")
    if a.skips and _declares_key_usage(second):
        raise _wrong_order(names, f"{names[1]} must know which worlds skip a step")
    for key, derived in a.derives:
        if key in b.delays and key in second.out_keys and derived not in b.delays:
            problem = f"{names[0]} computes {derived} from {key} before {names[1]} changes {key}"
            warnings.warn(f"order of transforms: {problem}", stacklevel=2)
    for (key, age), (held, grown) in itertools.product(a.ages, b.holds):
        if key == held and age != grown:
            problem = f"{names[1]} holds {key}, whose age {names[0]} writes under {age}"
            remedy = f"give {names[1]} age_key={age!r}, so that the age grows with what is held"
            warnings.warn(f"order of transforms: {problem}: {remedy}", stacklevel=2)


def leaf_transforms(transform: Transform | None) -> list[Any]:
    """All transforms of a Compose and of the Composes within it, in order; or the one transform."""
    if transform is None:
        return []
    if not isinstance(transform, Compose):
        return [transform]
    return [leaf for inner in transform for leaf in leaf_transforms(inner)]


def _usage_of(transform: Transform) -> KeyUsage:
    if _declares_key_usage(transform):
        return cast(Any, transform).key_usage
    ends = isinstance(transform, StepCounter) and transform.max_steps is not None
    ends = ends or isinstance(transform, (RandomTruncationTransform, TerminateTransform))
    # Not the properties: some of TorchRL's transforms choose their keys when these are first read.
    read, written = (transform.__dict__.get(name) or [] for name in ("_in_keys", "_out_keys"))
    if isinstance(transform, RewardSum) and not read:
        read, written = ["reward"], ["episode_reward"]
    others = [key for key in written if key not in read]
    return KeyUsage(
        may_end=ends or any(last_part(key) in ENDS for key in others),
        derives=[(key, other) for key in read for other in others],
        skips=isinstance(transform, ConditionalSkip),
    )


def _declares_key_usage(transform: Transform) -> bool:
    return isinstance(getattr(type(transform), "key_usage", None), property)


def _wrong_order(names: tuple[str, str], why: str) -> InputError:
    return InputError(f"order of transforms: {names[0]} must come after {names[1]}, because {why}")


def _common_keys(some: Sequence[NestedKey], others: Sequence[NestedKey]) -> list[NestedKey]:
    return [key for key in some if key in others]
