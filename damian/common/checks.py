"""Checks of settings; a failed check raises one line that names the key, the value and its unit.

Every number has a largest sensible value, even where a check names none, because single precision
overflows long before a computer refuses a number.
"""

import math
import string
from collections.abc import Iterable, Sequence
from typing import Any, TypeGuard

from damian.common.errors import InputError

METRES = 2.0e7
"""Half the circumference of the Earth [m]; no two places are farther apart."""
SECONDS = 1.0e6
"""Longest time: eleven days [s], which single precision still resolves to a sixteenth of a
second."""
STEPS = 1_000_000
"""Most steps of an episode, or between two updates of a learner."""
WORLDS = 1_000_000
"""Most worlds, or initial conditions."""
LARGEST = {"m": METRES, "m^2": METRES**2, "s": SECONDS, "dB": 300.0, "deg": 360.0}
"""Largest number allowed by its unit, where a check names none."""
HUGE, TINY = 1e9, 1e-9
"""Largest number of any other unit or of none, and smallest one where a check asks for one above
0."""

UNITS_OF_TIME = {"ms": 1e-3, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}
"""Seconds of each unit in which a time may be written."""


def require(condition: bool, key: str, value: Any, should: str) -> None:
    """Raise ``InputError("<key>: <value> <should>")`` unless the condition holds; a long value is
    cut."""
    if not condition:
        text = str(value)
        raise InputError(
            f"{key}: {text if len(text) <= 100 else f'{text[:50]}...{text[-25:]}'} {should}"
        )


def in_range(key: str, value: float, low: float, high: float | None = None, unit: str = "") -> None:
    """Require a number ``low <= value <= high``; without ``high``, the largest number of the
    unit."""
    most = max(low, LARGEST.get(unit, HUGE)) if high is None else high
    good = is_number(value) and low <= value <= most
    one_sided = high is None and not (is_number(value) and most < value < math.inf)
    bounds = f"at least {low:g}" if one_sided else f"between {low:g} and {most:g}"
    require(good, key, f"{value} {unit}".strip(), f"is not {bounds} {unit}".strip())


def whole(key: str, value: Any, low: int, high: float | None = None, unit: str = "") -> None:
    """Require a whole number ``low <= value <= high``; without ``high``, the largest number of the
    unit."""
    good = isinstance(value, int) and not isinstance(value, bool)
    require(good, key, f"{value} {unit}".strip(), "is not a whole number")
    in_range(key, value, low, high, unit)


def above(key: str, value: float, low: float, unit: str = "") -> None:
    """Require a number above ``low``, by ``TINY`` at least, up to the largest number of the
    unit."""
    good = is_number(value) and low < value < math.inf
    require(good, key, f"{value} {unit}".strip(), f"is not above {low:g} {unit}".strip())
    in_range(key, value, low + TINY, max(low + TINY, LARGEST.get(unit, HUGE)), unit)


def seconds(key: str, value: str | float, zero: bool = False) -> float:
    """Convert ``"2s"``, ``"133ms"``, ``"2min"``, or a number to seconds, which are 0 only with
    ``zero``."""
    text = str(value).strip()
    number = text.rstrip(string.ascii_lowercase)
    try:
        time = float(number) * UNITS_OF_TIME[text[len(number) :] or "s"]
    except (ValueError, KeyError):
        raise InputError(f"{key}: {value} is not a time such as 2s, 133ms, 2min or 1h") from None
    if not (zero and time == 0):
        above(key, time, 0.0, "s")
    return time


def place(key: str, value: Any) -> None:
    """Require a position ``[x, y]`` of two numbers [m] between ``-METRES`` and ``METRES``."""
    good = isinstance(value, Sequence) and len(value) == 2 and all(map(is_number, value))
    require(good and all(map(math.isfinite, value)), key, value, "is not [x, y] in metres")
    require(
        all(abs(v) <= METRES for v in value),
        key,
        value,
        f"is not within {METRES:g} m of the origin",
    )


def one_of(key: str, value: Any, choices: Iterable[Any]) -> None:
    """Require that the value is one of the choices."""
    choices = list(choices)
    names = ", ".join(map(str, choices))
    problem = f"is not one of {names}" if choices else "is not known, because there is none"
    require(value in choices, key, value, problem)


def names(key: str, given: Any, known: Sequence[str]) -> frozenset[Any]:
    """Require a collection of names, such as the extras of an environment, and none that is not
    known."""
    listed = isinstance(given, Iterable) and not isinstance(given, str)
    require(listed, key, repr(given), f"is not a list of names such as ['{known[0]}']")
    found = list(given)  # a generator can be read only once
    for name in found:
        one_of(key, name, known)
    return frozenset(found)


def distinct(key: str, values: Sequence[Any]) -> None:
    """Require that no value of a list appears twice."""
    again = next((value for i, value in enumerate(values) if value in values[:i]), None)
    require(again is None, key, again, "appears twice")


def device(key: str, value: str) -> None:
    """Require ``cpu`` or a CUDA device of this machine."""
    import torch  # noqa: PLC0415 (settings are read without it)

    n_gpus = torch.cuda.device_count()
    available = ["cpu", *(f"cuda:{i}" for i in range(n_gpus)), *["cuda"] * bool(n_gpus)]
    require(
        value in available, key, value, f"is not one of the devices here: {', '.join(available)}"
    )


def is_number(value: Any) -> TypeGuard[float]:
    """Is a value a number, and neither true nor false?"""
    return isinstance(value, int | float) and not isinstance(value, bool)
