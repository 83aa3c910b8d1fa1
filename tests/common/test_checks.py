"""Checks of settings: one failed check of each kind, and what they convert."""

import pytest

from damian.common import checks
from damian.common.errors import InputError

REFUSED = {
    "key: 7 m is not between 0 and 5 m": lambda: checks.in_range("key", 7, 0, 5, "m"),
    "key: 1.5 is not a whole number": lambda: checks.whole("key", 1.5, 1),
    "key: soon is not a time such as 2s, 133ms, 2min or 1h": lambda: checks.seconds("key", "soon"),
    "key: [3] is not [x, y] in metres": lambda: checks.place("key", [3]),
    "key: c is not one of a, b": lambda: checks.one_of("key", "c", ["a", "b"]),
}


@pytest.mark.parametrize("message", REFUSED)
def test_a_failed_check_is_one_line(message):
    with pytest.raises(InputError) as error:
        REFUSED[message]()
    assert str(error.value) == message


def test_times_are_converted_to_seconds():
    times = {
        "2s": 2.0,
        "133ms": 0.133,
        "0.5m": 30.0,
        "2min": 120.0,
        "1h": 3600.0,
        "1e2s": 100.0,
        0.2: 0.2,
    }
    assert [checks.seconds("key", time) for time in times] == [*times.values()]
