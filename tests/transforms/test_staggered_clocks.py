"""``SampleAndHold`` with random phases, beside a slow twin in plain Python."""

import math
from typing import Any

import pytest
import torch
from delay_twin import Counting
from helpers import play
from torch import Tensor
from torchrl.envs import TransformedEnv
from transform_cases import ACTION, N_AGENTS, OBSERVATION, ROWS, STEPS, WORLDS, choices, column, delayed

from damian.common import counter_rng
from damian.transforms import SampleAndHold

SENT, READY = ("agents", "message_sent"), ("agents", "ready")


def staggered(period: int = 4) -> SampleAndHold:
    return SampleAndHold(period, [SENT], [ACTION], ready_key=READY, stagger=True)


@pytest.mark.parametrize("period", [1, 2, 5])
def test_after_each_reset_the_clock_of_each_agent_begins_at_a_phase_of_its_own(period):
    transform, chosen = staggered(period), choices()
    outputs, undelayed = play(delayed(transform), chosen), play(Counting(WORLDS, N_AGENTS), chosen)
    ready, held, executed = (column(outputs, *key) for key in (READY, SENT, OBSERVATION))
    ready_now, sent, done = (column(undelayed, *key) for key in (READY, SENT, ("done",)))
    for (w, n), stream in zip(ROWS, transform.memory["streams"].tolist(), strict=True):
        episode, begins, ticks, sampled, executes = 1, True, False, sent[0][w][n], None
        for t in range(STEPS):
            at = 2 * t + 1
            if begins:
                draw = counter_rng.bits(torch.tensor(stream), torch.tensor(episode))
                until_tick = period - int(draw) % period
            executes = chosen[t][w, n].item() if begins or ticks else executes
            until_tick -= 1
            ticks = until_tick == 0
            until_tick = period if ticks else until_tick
            sampled = sent[at][w][n] if ticks else sampled
            assert [held[at][w][n], ready[at][w][n]] == [sampled, ticks and ready_now[at][w][n]]
            assert executed[at][w][n][5] == executes
            begins = done[at][w][0]
            if begins:
                episode, sampled = episode + 1, sent[at + 1][w][n]
                assert [held[at + 1][w][n], ready[at + 1][w][n]] == [sampled, ready_now[at + 1][w][n]]


def test_phases_are_spread_evenly_and_differ_between_episodes():
    period, worlds = 4, list(range(1000))
    transform = staggered(period)
    env = delayed(transform, worlds=worlds)
    env.reset()
    first = transform.memory["phase"].clone()
    env.reset()
    for found, chance in ((first, 1 / period), (transform.memory["phase"], 1 / period)):
        for phase in range(period):
            share = (found == phase).double().mean().item()
            assert abs(share - chance) < 5 * math.sqrt(chance * (1 - chance) / found.numel())
    same = (first == transform.memory["phase"]).double().mean().item()
    assert abs(same - 1 / period) < 5 * math.sqrt(3 / 16 / first.numel())


def test_a_seed_repeats_the_phases_and_without_stagger_nothing_is_drawn():
    def memory(**options: Any) -> dict[str, Tensor]:
        transform = SampleAndHold(50, [SENT], **options)
        TransformedEnv(Counting(WORLDS, N_AGENTS), transform).reset()
        return transform.memory

    one, again, other = (memory(stagger=True, seed=seed)["phase"] for seed in (1, 1, 2))
    assert one.equal(again)
    assert not one.equal(other)
    state = torch.random.get_rng_state()
    assert set(memory()) == {"elapsed", "held_0"}
    assert torch.random.get_rng_state().equal(state)
