"""The age of an observation that a slow clock holds, which ``SampleAndHold(age_key=...)`` writes."""

import pytest
import torch
from delay_twin import last_actions
from helpers import play
from transform_cases import (
    ACTION,
    LAWS,
    OBSERVATION,
    ROWS,
    STEPS,
    choices,
    column,
    delayed,
)

from damian.transforms import ActionHistory, ObservationDelay, SampleAndHold

SENT_AT = 2
"""Column of an observation of ``Counting`` with the step in which it was made."""


def clock(period: int = 3, **options) -> SampleAndHold:
    return SampleAndHold(period, [OBSERVATION], age_key="age", **options)


CLOCKS = {
    "one": lambda: [clock()],
    "staggered": lambda: [clock(4, stagger=True)],
    "one after another": lambda: [clock(2), clock(3)],
    "every step": lambda: [clock(1)],
}


@pytest.mark.sample(2)
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("clocks", CLOCKS.values(), ids=CLOCKS)
def test_the_age_is_that_of_the_observation_that_is_held(law, clocks, tmp_path):
    late = ObservationDelay(LAWS[law](tmp_path), [OBSERVATION], order="arrival")
    outputs = play(delayed(late, *clocks()), choices())
    held, age = torch.tensor(column(outputs, *OBSERVATION)), torch.tensor(column(outputs, "agents", "age"))
    now = (torch.arange(len(outputs)) + 1) // 2
    assert age.squeeze(-1).equal((now.view(-1, 1, 1) - held[..., SENT_AT]).float())
    assert len(age.unique()) > 1 or law == "none"


def test_a_history_keeps_the_actions_that_a_held_observation_does_not_reflect():
    default, chosen = 2, choices()
    history = ActionHistory(5, ACTION, default=default, age_key="age")
    outputs = play(delayed(ObservationDelay(1, [OBSERVATION]), clock(), history), chosen)
    held, found = column(outputs, *OBSERVATION), column(outputs, "agents", "action_history")
    done = torch.tensor(column(outputs, "done")).squeeze(-1)[1::2]
    for w, n in ROWS:
        actions: list[tuple[int, int]] = []
        for t in range(STEPS):
            actions.append((t, chosen[t][w, n].item()))
            made = held[2 * t + 1][w][n][SENT_AT]
            latest = last_actions(actions, 5, (-STEPS, default))
            expected = [action if made <= at else default for at, action in latest]
            assert torch.tensor(found[2 * t + 1][w][n]).equal(torch.tensor(expected) / 6)
            actions = [] if done[t, w] else actions


def test_the_age_grows_in_idle_steps_too():
    transform = clock()
    play(delayed(ObservationDelay(1, [OBSERVATION]), transform), choices(n_steps=4))
    memory = transform.memory
    idle = transform.after_idle_steps(memory, 5)
    assert idle["age"].equal(memory["age"] + 5)
    assert idle["elapsed"].equal((memory["elapsed"] + 5) % 3)


def test_an_age_that_is_held_with_the_observation_grows_too():
    held = SampleAndHold(3, [OBSERVATION, ("agents", "age")], age_key="age")
    found, expected = (
        column(play(delayed(ObservationDelay(1, [OBSERVATION]), each), choices()), "agents", "age")
        for each in (held, clock())
    )
    assert found == expected
