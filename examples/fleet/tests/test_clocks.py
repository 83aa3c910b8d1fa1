"""Messages from wrong clocks are found where they are, and others are not doubted, however late
they are."""

import numpy as np
import pandas as pd
import pytest

from damian.delays.clocks import in_order
from damian_fleet.clocks import are_right, note_on

N = 400
START = 1.77e9
TIMES = START + np.arange(N)
HALF = np.arange(N) < N // 2
LATER = np.arange(N) >= N // 2
LEVEL = np.full(N, 0.4)
UNIFORM = np.random.default_rng(0).uniform(0, 4, N)
HELD = np.where(np.arange(N) % 100 < 30, 6.0, 0.4)
"""Bursts of thirty late messages."""
QUEUE = np.where(np.arange(N) % 200 < 60, 60 - np.arange(N) % 200, 0) + LEVEL
"""A minute without a link, whose messages come in together at its end."""
NEWEST_FIRST = np.where(np.arange(N) % 200 < 60, 60 + 1.8 * (30 - np.arange(N) % 200), 0).clip(0.4)
BATCHES = 10.4 - np.arange(N) % 10
DELAYS = {
    "level": LEVEL,
    "uniform": UNIFORM,
    "bursts": HELD,
    "queue": QUEUE,
    "batches": BATCHES,
}
DELAYS |= {"newest first": NEWEST_FIRST}


def log_of(delays, behind=0.0, numbers=None, uav="u1"):
    """A log of a sender whose clock is behind by so much [s], in the order in which it came in."""
    log = pd.DataFrame(
        {
            "uav": uav,
            "time": TIMES - behind,
            "received": TIMES + delays,
        }
    )
    log["sequence"] = np.arange(N, dtype=float) if numbers is None else numbers
    log["where"] = [f"line {n}" for n in range(2, N + 2)]
    return log.sample(frac=1, random_state=0)


def wrong_ones(log):
    messages = in_order(log)
    return sorted(messages.index[~are_right(messages)])


@pytest.mark.parametrize("numbered", [True, False])
@pytest.mark.parametrize("delays", DELAYS)
def test_late_messages_alone_raise_no_doubt(delays, numbered):
    assert wrong_ones(log_of(DELAYS[delays], numbers=None if numbered else np.nan)) == []


ONE = np.arange(N) == 77
FIRST = np.arange(N) < 5
STEPS = {
    "set back for good": (LATER * 20.0, LATER),
    "set back by an hour, and forward": ((LATER & (np.arange(N) < 300)) * 3600.0, None),
    "ahead from some day on": (LATER * -20.0, LATER),
    "ahead, and set back": (HALF * -20.0, HALF),
    "slow, and set forward": (HALF * 20.0, HALF),
    "before the fix": (FIRST * (START - 5), FIRST),
    "in 1980 before the fix": (FIRST * (START - 315964800), FIRST),
    "one message without a fix": (ONE * START, ONE),
}


@pytest.mark.parametrize("numbered", [True, False])
@pytest.mark.parametrize("case", STEPS)
def test_a_step_of_a_clock_is_found_where_it_is(case, numbered):
    behind, wrong = STEPS[case]
    wrong = behind != 0 if wrong is None else wrong
    log = log_of(LEVEL, behind, None if numbered else np.nan)
    messages = in_order(log)
    right = are_right(messages)
    assert sorted(messages.index[~right]) == np.flatnonzero(wrong).tolist()
    note = note_on(messages, right)
    side = "behind" if behind[wrong][0] > 0 else "ahead"
    first = f"line {np.flatnonzero(wrong)[0] + 2}: the clock of u1 is "
    wrong_by = f"{abs(behind[wrong].mean()):.3g} s {side} in {wrong.sum()} messages from here on"
    assert note == f"note: {first}{wrong_by}: they are left out"


def test_numbers_show_a_step_that_is_smaller_than_the_spread_of_the_delays():
    log = log_of(UNIFORM, LATER * 3.0)
    assert wrong_ones(log) == np.flatnonzero(LATER).tolist()
    assert wrong_ones(log.assign(sequence=np.nan)) == []


RESTART = np.where(HALF, np.arange(N), np.arange(N) - N // 2).astype(float)


@pytest.mark.parametrize("behind", [0.0, (np.arange(N) - 200 < 5) * LATER * START])
def test_who_starts_anew_counts_anew(behind):
    log = log_of(UNIFORM, behind, RESTART).drop(index=[3, 199, 200])  # 200: the first number, again
    messages = in_order(log)
    assert messages.run.loc[[0, 198, 201, 399]].tolist() == [0, 0, 1, 1]
    assert [*messages.index] == [*log.index.sort_values()]
    assert wrong_ones(log) == ([201, 202, 203, 204] if np.any(behind) else [])


def test_a_sender_whose_clock_was_never_right_and_others():
    log = pd.concat([log_of(LEVEL), log_of(LEVEL, -2.0, uav="u2")], ignore_index=True)
    messages = in_order(log)
    right = are_right(messages)
    assert [right[messages.uav == uav].mean() for uav in ("u1", "u2")] == [1, 0]
