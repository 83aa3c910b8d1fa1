"""Sums of rewards, clocks and histories beside slow reference implementations in plain Python."""

import pytest
import torch
from delay_twin import (
    ACTION,
    LAWS,
    N_AGENTS,
    OBSERVATION,
    REWARD,
    ROWS,
    STEPS,
    WORLDS,
    Counting,
    after,
    before,
    choices,
    column,
    delayed,
)
from helpers import play

from damian import ActionHistory, CumulativeReward, ObservationDelay, RewardDelay, SampleAndHold


@pytest.fixture(params=LAWS)
def law(request, tmp_path):
    return LAWS[request.param](tmp_path)


def rewards_of(outputs):
    """Rewards [T][B][N][1], and flags of the ends of episodes [T][B][1], as nested lists."""
    return after(outputs, *REWARD), after(outputs, "done")


def test_a_reset_during_an_episode_discards_its_rewards_in_transit():
    env = delayed(RewardDelay(3, REWARD), ends=0.0)
    play(env, choices(n_steps=5))
    received, _ = rewards_of(play(env, choices(n_steps=3)))
    assert received == [[[[0.0]] * N_AGENTS] * len(WORLDS)] * 3


@pytest.mark.parametrize("steps", [1, 3, 8])
@pytest.mark.parametrize("gamma", [0.5, 1.0])  # their powers are exact in floats
def test_the_cumulative_reward_equals_equation_4(steps, gamma):
    earned, done = rewards_of(play(Counting(WORLDS, N_AGENTS), choices()))
    found, _ = rewards_of(play(delayed(CumulativeReward(steps, gamma, REWARD)), choices()))
    for w, n in ROWS:
        episode = []
        for t in range(STEPS):
            episode.append(earned[t][w][n][0])
            latest = episode[::-1][:steps]
            assert found[t][w][n][0] == sum(
                gamma**age * reward for age, reward in enumerate(latest)
            )
            episode = [] if done[t][w][0] else episode


@pytest.mark.parametrize("period", [1, 2, 3, 5])
def test_between_two_ticks_entries_and_actions_are_held_and_no_agent_is_ready(period):
    chosen = choices()
    clock = SampleAndHold(
        period, [("agents", "message_sent")], [ACTION], ready_key=("agents", "ready")
    )
    outputs = play(delayed(clock), chosen)
    undelayed = play(Counting(WORLDS, N_AGENTS), chosen)
    ready = column(outputs, "agents", "ready")
    held = column(outputs, "agents", "message_sent")
    ready_now, sent, done = (
        column(undelayed, *key)
        for key in (("agents", "ready"), ("agents", "message_sent"), ("done",))
    )
    executed = column(outputs, *OBSERVATION)
    for w, n in ROWS:
        elapsed = 0
        sampled = sent[0][w][n]
        executes = None
        for t in range(STEPS):
            at = 2 * t + 1
            reset = 2 * t + 2
            executes = chosen[t][w, n].item() if elapsed % period == 0 else executes
            elapsed += 1
            ticks = elapsed % period == 0
            sampled = sent[at][w][n] if ticks else sampled
            expected = [sampled, ticks and ready_now[at][w][n]]
            assert [held[at][w][n], ready[at][w][n]] == expected
            assert executed[at][w][n][5] == executes
            if done[at][w][0]:
                elapsed = 0
                sampled = sent[reset][w][n]
                expected = [sampled, ready_now[reset][w][n]]
            assert [held[reset][w][n], ready[reset][w][n]] == expected


HISTORIES = [
    (None, None, 1),
    ("ready", None, 1),
    (None, "age", 1),
    ("ready", "age", 1),
    ("ready", "age", 2),
]


@pytest.mark.sample(3)
@pytest.mark.parametrize(("recorded_key", "age_key", "reflected_after"), HISTORIES)
def test_the_history_is_the_end_of_a_list_of_actions_without_those_that_the_observation_reflects(
    law, recorded_key, age_key, reflected_after
):
    default = 2
    chosen = choices()
    late = ObservationDelay(law, [OBSERVATION])
    when = {"recorded_key": recorded_key, "reflected_after": reflected_after}
    history = ActionHistory(3, ACTION, default=default, age_key=age_key, **when)
    outputs = play(delayed(late, history), chosen)
    found = torch.stack([td["agents", "action_history"] for td in outputs])
    ages = after(outputs, "agents", "age")
    ready = before(outputs, "agents", "ready")
    done = after(outputs, "done")
    for w, n in ROWS:
        recorded = []
        for t in range(STEPS):
            recorded += [(t, chosen[t][w, n].item())] * (recorded_key is None or ready[t][w][n])
            generated = t + 1 - ages[t][w][n][0]
            for output in (2 * t + 1, 2 * t + 2):  # after the step, and after a reset
                latest = [*[(-STEPS, default)] * 3, *recorded][-3:]
                expected = [
                    default if age_key and generated - at >= reflected_after else action
                    for at, action in latest
                ]
                assert found[output, w, n].equal(torch.tensor(expected) / 6)
                recorded = [] if done[t][w][0] else recorded
