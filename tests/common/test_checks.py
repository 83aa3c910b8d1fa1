"""Checks that components of one's own use."""

import pytest

from damian.common import checks
from damian.common.errors import InputError


@pytest.mark.parametrize(
    ("check", "message"),
    [
        (
            lambda: checks.above("outer", 300.0, "50"),  # type: ignore[arg-type]
            "outer: 300.0 cannot be compared with '50', which is not a number",
        ),
        (
            lambda: checks.in_range("outer", 300.0, None, 5),  # type: ignore[arg-type]
            "outer: 300.0 cannot be compared with None, which is not a number",
        ),
        (
            lambda: checks.in_range("outer", 300.0, 0, "5"),  # type: ignore[arg-type]
            "outer: 300.0 cannot be compared with '5', which is not a number",
        ),
        (lambda: checks.above("outer", "3", 0.0, "m"), "outer: 3 m is not above 0 m"),  # type: ignore[arg-type]
        (
            lambda: checks.known_keys("options", {"iner": 5}, ["inner"]),
            "options.iner: 5 is not one of its options: inner",
        ),
        (
            lambda: checks.known_keys("options", 5, ["inner"]),
            "options: 5 is not a mapping such as {inner: 1}",
        ),
    ],
)
def test_a_failed_check_is_one_line(check, message):
    with pytest.raises(InputError) as error:
        check()
    assert str(error.value) == message


def test_options_that_are_known_are_returned():
    assert checks.known_keys("options", {"inner": 5}, ["inner", "outer"]) == {"inner": 5}
    assert checks.known_keys("options", None, ["inner"]) == {}
