"""What a search varies: settings of damian train, each with a range or with choices."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from damian.common import checks
from damian.common.errors import InputError

from .known_settings import known_settings
from .misspelt import no_such_key

WORDS = ({"choices"}, {"low", "high"}, {"low", "high", "log"}, {"low", "high", "step"})
"""Words with which the values of a setting can be written."""


class Suggests(Protocol):
    """What a trial of Optuna's offers."""

    def suggest_float(
        self, name: str, low: float, high: float, *, step: float | None, log: bool
    ) -> float: ...

    def suggest_int(self, name: str, low: int, high: int, *, step: int, log: bool) -> int: ...

    def suggest_categorical(self, name: str, choices: list[str]) -> str: ...


@dataclass(frozen=True)
class Values:
    """The values that a setting may have: those of a range, or choices."""

    low: float = 0.0
    high: float = 0.0
    step: float | None = None
    log: bool = False
    """Whether the logarithm is drawn from the range."""
    choices: tuple[str, ...] = ()
    """As they are written on a command line; if there are any, there is no range."""

    def suggest(self, trial: Suggests, key: str) -> str:
        """The value for a trial, as it is written on a command line."""
        if self.choices:
            return trial.suggest_categorical(key, [*self.choices])
        if isinstance(self.low, int) and isinstance(self.high, int):
            return str(trial.suggest_int(key, self.low, self.high, step=int(self.step or 1), log=self.log))
        return f"{trial.suggest_float(key, self.low, self.high, step=self.step, log=self.log):.6g}"


def read_space(search: Mapping[str, Any]) -> dict[str, Values]:
    """The values of each setting that a search varies, by its dotted key.

    Args:
        search: nested as the settings are; each as ``{low: 1, high: 8}``, with ``log: true`` or ``step``, or
            as ``{choices: [...]}``.

    Raises:
        InputError: a setting does not exist, or its values are not written so.
    """
    space = {}
    for key, written in _leaves(search, ""):
        if key not in known_settings("train"):
            raise InputError(f"search: {no_such_key(key, 'train')}")
        should = "is neither {low: ..., high: ...}, with log or step, nor {choices: [...]}"
        checks.require({*written} in WORDS, f"search.{key}", written, should)
        if "choices" in written:
            good = isinstance(written["choices"], list) and len(written["choices"]) > 0
            checks.require(good, f"search.{key}.choices", written["choices"], "is no list of values")
            space[key] = Values(
                choices=tuple(json.dumps(c, separators=(",", ":")) for c in written["choices"])
            )
            continue
        values = Values(**written)
        numbers = all(
            isinstance(x, int | float) and not isinstance(x, bool) for x in (values.low, values.high)
        )
        least = 0.0 if numbers and values.log else -float("inf")
        good = numbers and least < values.low < values.high
        should = "is no range: low must be less than high" + (", and more than 0" if values.log else "")
        checks.require(good, f"search.{key}", written, should)
        checks.require(isinstance(values.log, bool), f"search.{key}.log", values.log, "is not true or false")
        _check_step(f"search.{key}.step", values)
        space[key] = values
    if not space:
        raise InputError("search: it is empty: name a setting, such as search.learner.lr")
    return space


def _check_step(key: str, values: Values) -> None:
    """Check the step of a range.

    Raises:
        InputError: it is no number above 0, or no whole one in a range of whole numbers.
    """
    step, whole = values.step, isinstance(values.low, int) and isinstance(values.high, int)
    if step is None:
        return
    number = isinstance(step, int) or (isinstance(step, float) and not whole)
    good = number and not isinstance(step, bool) and step > 0
    checks.require(good, key, step, f"is no {'whole ' * whole}number above 0")


def _leaves(node: Mapping[str, Any], path: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """The settings in a nested mapping, by dotted key."""
    for name, below in node.items():
        key = f"{path}{name}"
        if not isinstance(below, Mapping):
            raise InputError(
                f"search.{key}: {below} is neither a range, nor choices, nor a section of settings"
            )
        if {*below} & {"low", "high", "choices"}:
            yield key, below
        else:
            yield from _leaves(below, f"{key}.")
