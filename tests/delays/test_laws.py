"""Delay laws: frequencies of delays and losses, playback of traces, and how a setting becomes a
law."""

import math
from importlib.resources import files

import pytest
import torch
from delay_twin import drawn

from damian import compose_scenario
from damian.common import counter_rng
from damian.delays.laws import (
    Burst,
    Constant,
    Geometric,
    Trace,
    Uniform,
    in_steps,
    law_of,
    sampler_of,
)
from damian.delays.samplers import HeldSampler

STREAMS, STEPS = 1000, 100
"""Size of a sample: 10^5 messages."""


def sample(sampler, n_streams=STREAMS, n_steps=STEPS):
    """Draw the delays of one message per stream and step, [T, M]."""
    return drawn(sampler, counter_rng.world_seeds(5, n_streams), n_steps)


def check_chances(sampler, chances, delays):
    """Compare the frequencies of delays with exact probabilities, within five deviations of
    chi-square.

    If the probabilities sum to less than 1, the rest is the probability of a loss.
    """
    expected = torch.zeros(sampler.lost + 1, dtype=torch.float64)
    for delay, chance in chances.items():
        expected[delay] = chance
    expected[sampler.lost] = max(round(1 - sum(chances.values()), 9), 0)
    expected *= delays.numel()
    counts = delays.flatten().bincount(minlength=len(expected)).double()
    possible = expected > 0
    assert len(counts) == len(expected)
    assert counts[~possible].sum() == 0
    excess = ((counts - expected)[possible].square() / expected[possible]).sum().item()
    freedom = int(possible.sum()) - 1
    assert excess <= freedom + 5 * math.sqrt(2 * freedom)


PAPER = Uniform("3s", "7s", 0.15)

LAWS = {
    "none": (Constant(), 1.0, {0: 1.0}),
    "steps": (Constant(3), 1.0, {3: 1.0}),
    "a time, rounded up": (Constant("0.5m"), 20.0, {2: 1.0}),
    "uniform steps": (Uniform(2, 5), 1.0, dict.fromkeys((2, 3, 4, 5), 0.25)),
    "the paper's": (PAPER, 1.0, {0: 0.85} | dict.fromkeys((4, 5, 6, 7), 0.0375)),
    "the paper's at a coarser step": (
        PAPER,
        2.0,
        {
            0: 0.85,
            2: 0.0375,
            3: 0.075,
            4: 0.0375,
        },
    ),
    "uniform within a step": (
        Uniform("0.5s", "2s"),
        1.0,
        {
            1: 1 / 3,
            2: 2 / 3,
        },
    ),
    "geometric": (
        Geometric(2, 6),
        1.0,
        {k: 2**k / 3 ** (k + 1) for k in range(6)} | {6: (2 / 3) ** 6},
    ),
    "a burst that never ends": (
        Burst(
            leave=0.0,
            bad=2,
            bad_loss=0.25,
        ),
        1.0,
        {2: 0.75},
    ),
}


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_delays_and_losses_are_as_frequent_as_the_law_says(name, loss):
    law, dt, chances = LAWS[name]
    sampler = law.sampler(dt, loss)
    check_chances(
        sampler, {k: chance * (1 - loss) for k, chance in chances.items()}, sample(sampler)
    )
    if loss == 0 and not isinstance(law, Burst):
        only = next(iter(chances)) if [*chances.values()] == [1.0] else None
        assert sampler.constant_delay == only


def within(found, exact, deviation):
    """Is the sample mean within five standard deviations of the exact one?"""
    return abs(found - exact) <= 5 * deviation


def share(flags):
    """Mean of the flags, and their number."""
    return flags.double().mean().item(), flags.numel()


BURST = Burst(
    enter=0.05,
    leave=0.2,
    good=0,
    bad=5,
    bad_loss=0.0,
)


def test_a_channel_changes_state_with_its_probabilities_so_that_a_burst_lasts_1_over_leave_steps():
    bad = sample(BURST.sampler()) == 5
    before = bad[:-1]
    after = bad[1:]
    for changed, chance in ((after[~before], 0.05), (~after[before], 0.2)):
        found, n = share(changed)
        assert within(found, chance, math.sqrt(chance * (1 - chance) / n))
    n_bursts = (after & ~before).sum().item()
    mean_length = after.sum().item() / n_bursts
    assert within(mean_length, 5.0, math.sqrt(2 * 0.8) / 0.2 / math.sqrt(n_bursts))


def test_losses_of_the_channel_state_and_general_losses_combine():
    law = Burst(
        enter=0.5,
        leave=0.5,
        good=1,
        bad=PAPER,
        good_loss=0.1,
        bad_loss=0.5,
    )
    sampler = law.sampler(loss=0.2)
    kept = 0.5 * 0.8
    chances = {0: 0.85 * 0.5 * kept, 1: 0.9 * kept} | dict.fromkeys(
        (4, 5, 6, 7), 0.0375 * 0.5 * kept
    )
    # Transition probabilities of 1/2 make the states of successive steps independent.
    check_chances(sampler, chances, sample(sampler))


def trace(tmp_path, *rows, header="delay"):
    file = tmp_path / "trace.csv"
    file.write_text("\n".join([header, *rows]) + "\n")
    return Trace(str(file))


def test_a_trace_is_played_in_order_from_a_random_start_and_wraps_around(tmp_path):
    recorded = [4, 0, 7, 1, 0, 2, 9]
    delays = sample(trace(tmp_path, *map(str, recorded)).sampler(), 300, 20).T.tolist()
    first_rounds = {tuple(row[:7]) for row in delays}
    rotations = [recorded[k:] + recorded[:k] for k in range(7)]
    assert sorted(first_rounds) == sorted(map(tuple, rotations))
    assert all(row == (row[:7] * 3)[:20] for row in delays)


def test_the_measured_trace_of_the_package_is_played_back():
    rows = (files("damian") / "data" / "queue_trace.csv").read_text("utf-8").split()[1:]
    arrive = [float(row.removesuffix("s")) for row in rows if row != "lost"]
    measured = compose_scenario("delay=measured").make_delays().obs
    assert 1000 <= len(rows) <= 3000
    assert measured.longest == math.ceil(max(arrive)) == 8
    played = sample(measured, 2, len(rows)).T.tolist()
    expected = sorted([*map(math.ceil, arrive), *[measured.lost] * (len(rows) - len(arrive))])
    assert all(sorted(row) == expected for row in played)


def test_a_trace_may_hold_times_losses_and_other_columns(tmp_path):
    rows = ['2021,"2s"', "2022,lost", "2023, 3 ", "2024,0s", "2025,0.1m"]
    sampler = trace(tmp_path, *rows, header="when,delay").sampler(dt=1.5)
    assert (sampler.longest, sampler.lost, sampler.constant_delay) == (4, 5, None)
    first = sample(sampler, 100, 5).T.tolist()
    assert {tuple(row) for row in first} == {
        tuple(([2, 5, 3, 0, 4] * 2)[k : k + 5]) for k in range(5)
    }


@pytest.mark.parametrize(
    ("setting", "law"),
    [
        ("3", Constant(3)),
        (Uniform(1, 2), Uniform(1, 2)),
        (
            {
                "law": "geometric",
                "mean": 1.5,
                "longest": "9",
            },
            Geometric(1.5, 9),
        ),
        (
            {"law": "burst", "bad": {"law": "uniform", "high": 3}},
            Burst(bad={"law": "uniform", "high": 3}),
        ),
    ],
)
def test_a_law_is_given_as_steps_a_time_or_a_mapping(setting, law):
    assert law_of(setting) == law


@pytest.mark.parametrize(
    ("delay", "dt", "steps"),
    [
        (3, 0.1, 3),
        ("3.01s", 1.0, 4),
        ("0.5m", 1.0, 30),
        ("133ms", 0.05, 3),
        (3.0, 1.0, 3),  # 3e0 on the command line
        ("0.3s", 0.1, 3),
    ],
)
def test_a_time_is_rounded_up_to_whole_steps(delay, dt, steps):
    assert in_steps("delay", delay, dt) == steps


@pytest.mark.parametrize(
    ("law", "loss", "arrival"),
    [
        (0, 0.0, 0),
        (3, 0.2, 3),
        (Uniform(1, 3), 0.2, None),
        (Burst(enter=0.0, good=2, bad=2, good_loss=0.0), 0.2, 2),
    ],
)
def test_what_arrives_may_be_equally_late_though_some_is_lost(law, loss, arrival):
    sampler = sampler_of(law, 1.0, loss)
    assert sampler.arrival_delay == arrival
    assert sampler.constant_delay == (None if loss else arrival)
    assert HeldSampler(sampler).arrival_delay == sampler.longest
