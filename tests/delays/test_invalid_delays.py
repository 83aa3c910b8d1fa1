"""Errors for invalid delay laws, settings of delays and traces: one line each."""

import math

import pytest

from damian.common.errors import InputError
from damian.delays.config import DelayConfig
from damian.delays.laws import LONGEST, Burst, Constant, Trace
from damian.envs.scenario import ScenarioConfig


def trace(tmp_path, *rows: str, header: str = "delay") -> Trace:
    file = tmp_path / "trace.csv"
    file.write_text("\n".join([header, *rows]) + "\n")
    return Trace(str(file))


STEPS_OR_TIME = "is neither whole steps such as 3 nor a time such as 3s or 0.5m"
NO_TIME = "is not a time such as 2s, 0.5m or 1h"
NOT_ORDERED = "are not two steps or two times"
PROBABILITY = "delay.obs.probability:"

INVALID_LAWS = [
    (-1, "delay.obs: -1 " + STEPS_OR_TIME),
    (1.5, "delay.obs: 1.5 " + STEPS_OR_TIME),
    (2.0, "delay.obs: 2.0 " + STEPS_OR_TIME),
    (True, "delay.obs: True " + STEPS_OR_TIME),
    (None, "delay.obs: None " + STEPS_OR_TIME),
    (math.nan, "delay.obs: nan " + STEPS_OR_TIME),
    (math.inf, "delay.obs: inf " + STEPS_OR_TIME),
    ([3], "delay.obs: [3] " + STEPS_OR_TIME),
    (LONGEST + 1, f"delay.obs: {LONGEST + 1} is more than {LONGEST} steps"),
    ("3h", f"delay.obs: 3h is more than {LONGEST} steps"),
    ("xs", f"delay.obs: xs {NO_TIME}"),
    ("s", f"delay.obs: s {NO_TIME}"),
    ("-3s", "delay.obs: -3.0 s is not above 0 s"),
    ("nans", "delay.obs: nan s is not above 0 s"),
    ("infs", "delay.obs: inf s is not above 0 s"),
    ({}, "delay.obs.law: None is not one of constant, uniform, geometric, burst, trace"),
    ({"law": "gauss"}, "delay.obs.law: gauss is not one of constant, uniform, geometric, burst, trace"),
    ({"law": ["uniform"]}, "delay.obs.law: ['uniform'] is not one of constant,"),
    (
        {"law": "uniform", "lo": 3},
        "delay.obs.lo: 3 is no setting of the law uniform, which has low, high, pro",
    ),
    ({"law": "constant", 3: 3}, "delay.obs.3: 3 is no setting of the law constant, which has delay"),
    ({"law": "uniform", "low": -1, "high": 2}, "delay.obs.low: -1 " + STEPS_OR_TIME),
    ({"law": "uniform", "low": 0.5, "high": 2}, "delay.obs.low: 0.5 " + STEPS_OR_TIME),
    ({"law": "uniform", "high": True}, "delay.obs.high: True " + STEPS_OR_TIME),
    ({"law": "uniform", "low": 4, "high": 2}, f"delay.obs.low: 4 and high=2 {NOT_ORDERED}"),
    ({"law": "uniform", "low": "4s", "high": "2s"}, "delay.obs.low: 4s and high=2s are not two steps or two"),
    ({"law": "uniform", "low": 2, "high": "4s"}, f"delay.obs.low: 2 and high=4s {NOT_ORDERED}"),
    ({"law": "uniform", "low": "2s", "high": 4}, f"delay.obs.low: 2s and high=4 {NOT_ORDERED}"),
    ({"law": "uniform", "high": 2, "probability": 1.5}, f"{PROBABILITY} 1.5 is not between 0 and 1"),
    ({"law": "uniform", "high": 2, "probability": -0.1}, f"{PROBABILITY} -0.1 is not between 0 and 1"),
    ({"law": "uniform", "high": 2, "probability": math.nan}, f"{PROBABILITY} nan is not between 0 and"),
    ({"law": "uniform", "high": 2, "probability": "often"}, f"{PROBABILITY} often is not between 0 an"),
    ({"law": "uniform", "high": "3h"}, f"delay.obs.high: 3h is more than {LONGEST} steps"),
    ({"law": "geometric", "mean": -1}, "delay.obs.mean: -1 steps is not at least 0 steps"),
    ({"law": "geometric", "mean": math.nan}, "delay.obs.mean: nan steps is not at least 0 steps"),
    ({"law": "geometric", "mean": math.inf}, "delay.obs.mean: inf steps is not at least 0 steps"),
    ({"law": "geometric", "mean": None}, "delay.obs.mean: None steps is not at least 0 steps"),
    ({"law": "geometric", "mean": "xs"}, f"delay.obs.mean: xs {NO_TIME}"),
    ({"law": "geometric", "longest": 2.5}, "delay.obs.longest: 2.5 " + STEPS_OR_TIME),
    ({"law": "geometric", "longest": LONGEST + 1}, f"delay.obs.longest: {LONGEST + 1} is more than"),
    ({"law": "burst", "enter": 1.5}, "delay.obs.enter: 1.5 is not between 0 and 1"),
    ({"law": "burst", "leave": -1}, "delay.obs.leave: -1 is not between 0 and 1"),
    ({"law": "burst", "enter": 0, "leave": 0}, "delay.obs.enter + leave: 0 is not above 0"),
    ({"law": "burst", "good_loss": 2}, "delay.obs.good_loss: 2 is not between 0 and 1"),
    ({"law": "burst", "bad_loss": -0.1}, "delay.obs.bad_loss: -0.1 is not between 0 and 1"),
    ({"law": "burst", "bad": -3}, "delay.obs.bad: -3 " + STEPS_OR_TIME),
    ({"law": "burst", "good": {"law": "gauss"}}, "delay.obs.good.law: gauss is not one of constant,"),
    ({"law": "burst", "bad": {"law": "burst"}}, "delay.obs.bad: {'law': 'burst'} is not a memoryless law"),
    ({"law": "trace"}, "delay.obs.path: it is missing: the file with the delays"),
]


@pytest.mark.parametrize(("setting", "error"), INVALID_LAWS, ids=lambda value: str(value)[:50])
@pytest.mark.parametrize("name", ["obs", "act", "rew"])
def test_an_invalid_law_raises_one_line_that_names_its_key(name, setting, error):
    with pytest.raises(InputError) as caught:
        ScenarioConfig(delay=DelayConfig(**{name: setting}))
    message = str(caught.value)
    assert message.startswith(error.replace("delay.obs", f"delay.{name}"))
    assert "\n" not in message


@pytest.mark.parametrize(
    ("settings", "error"),
    [
        ({"loss": -0.1}, "delay.loss: -0.1 is not between 0 and 1"),
        ({"loss": 2}, "delay.loss: 2 is not between 0 and 1"),
        ({"loss": math.nan}, "delay.loss: nan is not between 0 and 1"),
        ({"loss": "0.1"}, "delay.loss: 0.1 is not between 0 and 1"),
        ({"order": "newest"}, "delay.order: newest is not one of generation, arrival"),
        ({"order": None}, "delay.order: None is not one of generation, arrival"),
        ({"history": -1}, "delay.history: -1 actions is not between 0 and 1000 actions"),
        ({"history": 1001}, "delay.history: 1001 actions is not between 0 and 1000 actions"),
        ({"history": "4"}, "delay.history: 4 actions is not a whole number"),
        ({"history": 2.5}, "delay.history: 2.5 actions is not a whole number"),
        ({"history": True}, "delay.history: True actions is not a whole number"),
        ({"reward_window": 2.5}, "delay.reward_window: 2.5 steps is not a whole number"),
        ({"reward_discount": 0}, "delay.reward_discount: 0 is not above 0"),
        ({"reward_window": 0}, "delay.reward_window: 0 steps is not between 1 and 10000 steps"),
        ({"reward_discount": 1.1}, "delay.reward_discount: 1.1 is not between 0 and 1"),
        ({"reward_discount": math.nan}, "delay.reward_discount: nan is not above 0"),
    ],
    ids=str,
)
def test_an_invalid_delay_setting_raises_an_error_that_names_its_key(settings, error):
    with pytest.raises(InputError) as caught:
        DelayConfig(**settings)
    assert str(caught.value) == error


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("", "is empty"),
        ("when,late\n1,2\n", "line 1: no column delay; the file has 'late', 'when'"),
        ("Delay\n2\n", "line 1: no column delay; did you mean 'Delay'?"),
        ("delay\n", "line 2: there is no delay under the header"),
        ("delay\n2\nsoon\n", "line 3: delay: soon"),
        ("delay\n2\n\n3\n-1\n", "line 5: delay: -1"),
        ("delay\n1.5\n", "line 2: delay: 1.5"),
        ("when,delay\n1,2\n2\n", "line 3: 1 values for 2 columns"),
        ("when,delay\n1,2\n1,2,3\n", "line 3: 3 values for 2 columns"),
        ("delay,delay\n1,2\n", "line 1: the column 'delay' appears 2 times"),
        ('delay\n1\n"2\n3\n', "line 4: unexpected end of data; give comma-separated values"),
        ("delay\n" + "1" * 200_000, "line 2: field larger than field limit (131072)"),
        ("delay\n1\n\0\n", "line 3: a NUL byte is not text"),
        (f"delay\n0\n{LONGEST + 1}\n", f"line 3: delay: {LONGEST + 1} is more than {LONGEST} steps"),
        (b"delay\n\xff\n", "byte 6 is not UTF-8 text"),
    ],
    ids=str,
)
def test_an_invalid_trace_raises_one_line_that_names_the_file_and_the_line(tmp_path, text, error):
    file = tmp_path / "trace.csv"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError) as caught:
        DelayConfig(obs={"law": "trace", "path": str(file)}).check(1.0)
    assert str(caught.value).startswith(f"{file}: {error}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("name", "error"), [("none.csv", "no such file"), ("", "is not a file")])
def test_a_missing_trace_raises_an_error_that_names_the_file(tmp_path, name, error):
    file = tmp_path / name
    with pytest.raises(InputError) as caught:
        DelayConfig(act={"law": "trace", "path": str(file)}).check(1.0)
    assert str(caught.value) == f"{file}: {error}"


def test_a_trace_is_refused_as_a_law_of_a_burst_because_it_has_memory(tmp_path):
    with pytest.raises(InputError) as caught:
        Burst(good=trace(tmp_path, "1")).sampler(key="delay.obs")
    assert str(caught.value).startswith("delay.obs.good: Trace(path=")


def test_a_loss_probability_outside_0_and_1_is_refused():
    for loss in (-0.1, 2, math.nan):
        with pytest.raises(InputError, match=r"loss: .* is not between 0 and 1"):
            Constant(1).sampler(loss=loss)


@pytest.mark.parametrize(
    ("setting", "error"),
    [
        ("\u00b2", "delay.obs: \u00b2 is neither whole steps"),
        ("9" * 5000, "is neither whole steps"),
        ({"law": "trace", "path": "5"}, "5: no such file"),
        ("1e308s", "1e+308 s is not between 1e-09 and 1e+06 s"),
        ({"law": "uniform", "low": "2.9s", "high": "2.1s"}, "are not two steps or two times in order"),
    ],
)
def test_a_setting_that_only_resembles_a_delay_raises_one_line(setting, error):
    with pytest.raises(InputError) as caught:
        DelayConfig(obs=setting).check(1.0)
    assert error in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_a_reward_delay_that_loses_rewards_is_refused():
    with pytest.raises(InputError, match="no reward may be lost"):
        DelayConfig(rew={"law": "burst"}).check(1.0)
