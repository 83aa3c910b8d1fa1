"""Checks of settings: one failed check of each kind, and what they convert."""

import pytest

from damian.common import checks
from damian.common.errors import InputError


@pytest.mark.parametrize(
    ("check", "message"),
    [
        (lambda: checks.in_range("key", 7, 0, 5, "m"), "key: 7 m is not between 0 and 5 m"),
        (lambda: checks.in_range("key", -1, 0), "key: -1 is not at least 0"),
        (lambda: checks.in_range("key", 1e30, 0, unit="s"), "key: 1e+30 s is not between 0 and 1e+06 s"),
        (lambda: checks.above("key", "3", 0.0, "m"), "key: 3 m is not above 0 m"),  # type: ignore[arg-type]
        (lambda: checks.above("key", float("nan"), 0.0), "key: nan is not above 0"),
        (lambda: checks.whole("key", 1.5, 1), "key: 1.5 is not a whole number"),
        (lambda: checks.seconds("key", "soon"), "key: soon is not a time such as 2s, 0.5m or 1h"),
        (lambda: checks.place("key", [3]), "key: [3] is not [x, y] in metres"),
        (lambda: checks.one_of("key", "c", ["a", "b"]), "key: c is not one of a, b"),
        (lambda: checks.names("key", "a", ["a"]), "key: 'a' is not a list of names such as ['a']"),
        (
            lambda: checks.known_keys("key", {"iner": 5}, ["inner"]),
            "key.iner: 5 is not one of its options: inner",
        ),
        (lambda: checks.known_keys("key", 5, ["inner"]), "key: 5 is not a mapping such as {inner: 1}"),
        (lambda: checks.distinct("key", [1, 2, 1]), "key: 1 appears twice"),
        (lambda: checks.device("key", "foo"), "key: foo is not one of the devices here: cpu"),
    ],
)
def test_a_failed_check_is_one_line(check, message):
    with pytest.raises(InputError) as error:
        check()
    assert str(error.value) == message


def test_what_is_right_passes_and_is_converted():
    assert [checks.seconds("key", time) for time in ("2s", "0.5m", "1h", 0.2)] == [2.0, 30.0, 3600.0, 0.2]
    assert checks.known_keys("key", {"inner": 5}, ["inner", "outer"]) == {"inner": 5}
    assert checks.known_keys("key", None, ["inner"]) == {}
