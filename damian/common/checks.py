"""Checks of settings; a failed check raises one line that names the key, the value and its unit."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch

from damian.common.errors import InputError

_SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0}


def require(condition: bool, key: str, value: Any, should: str) -> None:
    """Raise ``InputError("<key>: <value> <should>")`` unless the condition holds."""
    if not condition:
        raise InputError(f"{key}: {value} {should}")


def in_range(key: str, value: float, low: float, high: float = math.inf, unit: str = "") -> None:
    """Require a finite number ``low <= value <= high``."""
    _require_bounds(key, value, low, high)
    unit = f" {unit}" if unit else ""
    bounds = f"at least {low:g}" if math.isinf(high) else f"between {low:g} and {high:g}"
    good = isinstance(value, int | float) and low <= value <= high and value < math.inf
    require(good, key, f"{value}{unit}", f"is not {bounds}{unit}")


def finite(key: str, value: Any, unit: str = "") -> None:
    """Require a finite number."""
    good = isinstance(value, int | float) and math.isfinite(value)
    require(good, key, f"{value} {unit}".strip(), "is not a finite number")


def whole(key: str, value: Any, low: int, high: float = math.inf, unit: str = "") -> None:
    """Require a whole number ``low <= value <= high``."""
    good = isinstance(value, int) and not isinstance(value, bool)
    require(good, key, f"{value} {unit}".strip(), "is not a whole number")
    in_range(key, value, low, high, unit)


def above(key: str, value: float, low: float, unit: str = "") -> None:
    """Require a finite number above ``low``."""
    _require_bounds(key, value, low)
    unit = f" {unit}" if unit else ""
    good = isinstance(value, int | float) and low < value < math.inf
    require(good, key, f"{value}{unit}", f"is not above {low:g}{unit}")


def known_keys(key: str, given: Any, known: Iterable[str]) -> dict[str, Any]:
    """Require a mapping without unknown keys, such as the options of a component of one's own.

    Args:
        key: of the setting, for errors.
        given: the mapping, or None for an empty one.
        known: the keys that it may have.

    Returns:
        The mapping.
    """
    known = list(known)
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise InputError(f"{key}: {given} is not a mapping such as {{{known[0]}: 1}}")
    for name, value in given.items():
        require(name in known, f"{key}.{name}", value, f"is not one of its options: {', '.join(known)}")
    return dict(given)


def one_of(key: str, value: Any, choices: Iterable[Any]) -> None:
    """Require that the value is one of the choices."""
    choices = list(choices)
    require(value in choices, key, value, f"is not one of {', '.join(map(str, choices))}")


def place(key: str, value: Any) -> None:
    """Require a position ``[x, y]`` of two finite numbers [m]."""
    good = isinstance(value, Sequence) and len(value) == 2
    good = good and all(isinstance(v, int | float) and math.isfinite(v) for v in value)
    require(good, key, value, "is not [x, y] in metres")


def seconds(key: str, value: str | float) -> float:
    """Convert a time to seconds: ``"2s"``, ``"0.5m"``, ``"1h"``, or a bare number of seconds.

    Raises:
        InputError: the value is no time, or not above 0 s.
    """
    text = str(value).strip()
    number, unit = (text[:-1], text[-1]) if text[-1:] in _SECONDS else (text, "s")
    try:
        time = float(number) * _SECONDS[unit]
    except ValueError:
        raise InputError(f"{key}: {value} is not a time such as 2s, 0.5m or 1h") from None
    above(key, time, 0.0, "s")
    return time


def device(key: str, value: str) -> None:
    """Require ``cpu`` or a CUDA device of this machine."""
    available = ["cpu"] + [f"cuda:{i}" for i in range(torch.cuda.device_count())]
    available += ["cuda"] * (len(available) > 1)
    require(value in available, key, value, f"is not one of the devices here: {', '.join(available)}")


def _require_bounds(key: str, value: Any, *bounds: Any) -> None:
    """Require that the bounds with which a value is compared are numbers."""
    for bound in bounds:
        good = isinstance(bound, int | float)
        require(good, key, value, f"cannot be compared with {bound!r}, which is not a number")
