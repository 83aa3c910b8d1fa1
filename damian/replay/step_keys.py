"""What a ``BackupdateStorage`` needs of stored steps and of ``recompute``, and checks of both."""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.envs import EnvBase

from damian import keys
from damian.common import checks
from damian.common.errors import InputError
from damian.keys import next_key
from damian.transforms.entries import Entries, sibling_key

Recompute = Callable[[TensorDictBase, Tensor], dict[NestedKey, Tensor]]
"""Function from steps [T, B], and the newest message that the receiver can hold after each step, [T, B, M] or
[T, B, N, M], to entries after the steps, by key, such as ``{("next", "reward"): reward}``.

Each entry has the shape and dtype of the stored one. ``("next", "done")``, ``("next", "terminated")`` and
``("next", "truncated")`` [T, B, 1] are all among them, or none of them: then the stored ends stay.
"""

ENDS = tuple(map(next_key, keys.ENDS))
"""Keys of the flags that end an episode after a step."""


class StepKeys(NamedTuple):
    """Keys of the entries that the storage reads and writes; all but ``step_count`` are under ``"next"``."""

    message: NestedKey
    received: NestedKey
    delay: NestedKey
    age: NestedKey
    step_count: NestedKey
    hindsight: NestedKey | None

    @property
    def backupdated(self) -> NestedKey:
        """The flag beside ``delay`` that the storage adds, but not under ``"next"``."""
        return cast(NestedKey, sibling_key(self.delay, "backupdated"))

    @property
    def hindsight_age(self) -> NestedKey:
        """The age of the messages of ``hindsight``, which the storage adds, but not under ``"next"``."""
        return cast(NestedKey, sibling_key(self.delay, "hindsight_age"))


def example_steps(env: EnvBase) -> TensorDictBase:
    """Two steps [2, B] of zeros with the entries that ``env`` outputs; B is 1 if it has no batch size.

    Raises:
        InputError: the batch size of ``env`` has more than one dimension.
    """
    worlds = list(env.batch_size)
    checks.require(len(worlds) < 2, "env", f"the batch size {worlds}", "is not [] or [B]")
    return env.fake_tensordict().expand(2, *(worlds or [1])).clone()


def check_steps(steps: TensorDictBase, step_keys: StepKeys) -> None:
    """Check that steps [T, B] tell where episodes begin and end.

    Raises:
        InputError: an entry is missing or has another shape; the line says which one, and how to get it.
    """
    count, end = "the number of earlier steps in the episode, [T, B, 1]", "the end of an episode, [T, B, 1]"
    collected = "store steps as a rollout or a collector returns them"
    for name, key, holds, remedy in (
        ("step_count_key", step_keys.step_count, count, "add StepCounter()"),
        ("done", ENDS[0], end, collected),
    ):
        _require_shape(steps, name, key, _find(steps, name, key, holds, remedy).shape, [*steps.shape, 1])


def check_messages(steps: TensorDictBase, step_keys: StepKeys) -> None:
    """Check that steps [T, B] have every entry of messages that the storage needs.

    Raises:
        InputError: an entry is missing or has another shape; the line says which one, and how to get it.
    """
    message, received, delay, age, _, hindsight = step_keys
    remedy = "the environment must output it; that of UAVs does with make_env(..., extras=['message'])"
    holds = "the message sent in each step, [T, B, M] or [T, B, N, M]"
    shape = list(_find(steps, "message_key", next_key(message), holds, remedy).shape)
    should = f"has the shape {shape}, which is not [T, B, M] or [T, B, N, M]"
    checks.require(len(shape) in (3, 4), "message_key", next_key(message), should)
    rows = "T, B, N" if len(shape) == 4 else "T, B"
    add_delay = (
        f"add ObservationDelay(delay, [{message!r}], [{received!r}], age_key={age!r}, delay_key={delay!r})"
    )
    held = f"the message that the receiver holds after each step, [{rows}, M]"
    lateness = f"the delay of the message sent in each step [steps], [{rows}, 1]"
    oldness = f"the age of the message that the receiver holds [steps], [{rows}, 1]"
    for name, key, holds, expected in (
        ("received_key", next_key(received), held, shape),
        ("delay_key", next_key(delay), lateness, [*shape[:-1], 1]),
        ("age_key", next_key(age), oldness, [*shape[:-1], 1]),
    ):
        _require_shape(steps, name, key, _find(steps, name, key, holds, add_delay).shape, expected)
    if hindsight is not None:
        free = next_key(hindsight) not in steps.keys(True)
        checks.require(free, "hindsight_key", next_key(hindsight), "is an entry of the steps already")


def check_returned(entries: Any, steps: TensorDictBase, step_keys: StepKeys) -> None:
    """Check what ``recompute`` returns for steps [T, B], before any corrections.

    Raises:
        InputError: it is not a dict of entries after the steps, each of which the steps have, with the same
            dimensions; the number of columns is checked later.
    """
    should = "is not a dict of entries by key, such as {('next', 'reward'): reward}"
    checks.require(isinstance(entries, dict), "recompute", f"a {type(entries).__name__}", should)
    useful = bool(entries) or step_keys.hindsight is not None
    checks.require(useful, "recompute", entries, "corrects nothing: return at least one entry")
    recorded = {next_key(key) for key in step_keys[:4]}
    for written, value in entries.items():
        key = unravel_key(written)
        should = "is not after the step: its key must begin with 'next'"
        checks.require(key[0] == "next", "recompute", key, should)
        should = (
            "tells what was known at the time, and must stay: with hindsight_key, late messages are stored"
        )
        checks.require(key not in recorded, "recompute", key, should)
        stored = _find_returned(steps, key)
        checks.require(isinstance(value, Tensor), "recompute", key, f"is a {type(value).__name__}, no tensor")
        if value.shape[:-1] != stored.shape[:-1]:
            _require_shape(steps, "recompute", key, value.shape, stored.shape)


def check_entries(entries: Entries, steps: TensorDictBase) -> None:
    """Check entries after steps [T, B], as recomputed and corrected.

    Raises:
        InputError: one has another shape or dtype than the stored one, or one of the three ends is missing.
    """
    for key, value in entries.items():
        stored = _find_returned(steps, key)
        _require_shape(steps, "recompute", key, value.shape, stored.shape)
        should = f"has the dtype {value.dtype}, not {stored.dtype}"
        checks.require(value.dtype == stored.dtype, "recompute", key, should)
    missing = [key for key in ENDS if key not in entries]
    should = f"is missing: return {ENDS[0]}, {ENDS[1]} and {ENDS[2]}, or none of them"
    checks.require(len(missing) in (0, len(ENDS)), "recompute", missing and missing[0], should)


def _find_returned(steps: TensorDictBase, key: NestedKey) -> Any:
    """The stored entry that ``recompute`` returns under a key."""
    remedy = "StepCounter(max_steps=...) adds it" if key == ENDS[2] else "the environment must output it"
    return _find(steps, "recompute", key, "which it returns", remedy)


def _find(steps: TensorDictBase, name: str, key: NestedKey, holds: str, remedy: str) -> Any:
    """The entry with this key."""
    value = steps.get(key, None)
    if value is None:
        raise InputError(f"{name}: the steps have no {key}, {holds}: {remedy}")
    return value


def _require_shape(steps: TensorDictBase, name: str, key: NestedKey, got: Any, expected: Any) -> None:
    """Require that an entry of these steps, or its replacement, has the expected shape."""
    n_steps, n_worlds = steps.shape
    should = f"has the shape {list(got)}, not {list(expected)} (T = {n_steps} steps of B = {n_worlds} worlds)"
    checks.require(list(got) == list(expected), name, key, should)
