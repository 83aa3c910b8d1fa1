"""Samplers of laws that hold delays or read the context: frequencies, rounding, and what they
tell."""

import math

import pytest
import torch
from delay_twin import drawn

from damian import Distance, Lag, Uniform
from damian.common import counter_rng
from damian.delays.samplers import ContextSampler, LinkSampler, MessageContext, Recorded, Sampler

SENDERS = 20_000


def require_share(found, expected):
    """Is the share of true flags as expected, within five standard deviations of a binomial
    distribution?"""
    deviation = math.sqrt(max(expected * (1 - expected), 1e-9) / found.numel())
    assert abs(found.double().mean().item() - expected) < 5 * deviation


# States.


class Doubling(Sampler):
    """The state is a float, which doubles with every message: 0.4, 0.8, 1.6, ... steps, rounded
    down."""

    def __init__(self):
        super().__init__(3, loses=False)

    def initial_state(self, streams):
        return torch.full(streams.shape, 0.4)

    def forward(self, streams, clock, state, context=None):
        return state.clamp(max=3).long(), 2 * state


def test_links_keep_the_states_of_all_samplers_floats_or_not():
    samplers = [Doubling(), Recorded([3, 1, 0, 2]), Lag(Uniform(0, 3), "episode").sampler()]
    index = torch.tensor([0, 1, 2, 0])
    streams = counter_rng.world_seeds(5, 4 * 30)
    found = drawn(LinkSampler(samplers, index, torch.zeros(4)), streams, 9)
    for k, sampler in enumerate(samplers):
        link = index.repeat(30) == k
        assert found[:, link].equal(drawn(sampler, streams, 9)[:, link])


# Contexts.


def context_of(uniform, dt=1.0, **entries):
    """A context of messages about which nothing but a random number and some entries are known."""
    zero = torch.zeros_like(uniform).long()
    return MessageContext(zero, zero - 1, zero + 1, zero.float(), uniform, dt, entries)


@pytest.mark.parametrize(
    ("loses", "expected"),
    [
        (True, [6, 5, 6, 3, 5, 0]),
        (False, [0, 5, 0, 3, 5, 0]),
    ],
)
def test_delays_are_rounded_up_and_cut_and_negative_ones_are_lost(loses, expected):
    values = torch.tensor([math.nan, math.inf, -0.5, 2.1, 99.0, 0.0])
    sampler = ContextSampler(lambda _: values, 5, loses=loses)
    delay, _ = sampler(torch.arange(6), torch.tensor(1), torch.zeros(6), context_of(torch.rand(6)))
    assert delay.tolist() == expected
    assert (sampler.longest, sampler.lost, sampler.constant_delay, sampler.loses) == (
        5,
        6,
        None,
        loses,
    )
    assert ContextSampler(lambda _: values, 5, loss=0.1, loses=loses).loses


def test_the_rounding_errors_of_a_float_cost_no_step():
    senders = torch.tensor([7, 14, 17, 19])
    delays = senders * 0.3 / 0.1  # in float32: 21.000002, 42.000004, ...
    assert (delays.ceil() > 3 * senders).any()
    for values, expected in ((delays, 3 * senders), (delays.round() + 0.001, 3 * senders + 1)):
        sampler = ContextSampler(lambda _, values=values: values, 100)
        delay, _ = sampler(senders, torch.tensor(1), senders, context_of(torch.rand(4)))
        assert delay.equal(expected)


# Distances.


def at_distance(law, distance, loss=0.0, dt=1.0, **entries):
    """Delays of messages sent at this distance east of the origin [M], -1 for a lost one."""
    streams = counter_rng.world_seeds(3, SENDERS)
    clock = torch.tensor(1)
    place = torch.tensor([[distance, 0.0]]).expand(SENDERS, 2)
    context = context_of(counter_rng.uniform(streams, clock), dt, position=place, **entries)
    sampler = law.sampler(dt, loss)
    delay, _ = sampler(streams, clock, torch.zeros_like(streams), context)
    return torch.where(delay == sampler.lost, -1, delay)


def test_half_of_the_messages_are_lost_at_the_range_and_more_beyond_it():
    law = Distance(range=100.0, path_loss_exponent=3.0, shadowing=8.0)
    require_share(at_distance(law, 100.0) == -1, 0.5)
    expected = 0.5 * math.erfc(30 * math.log10(100 / 80) / 8 / math.sqrt(2))  # 30 dB per decade
    require_share(at_distance(law, 80.0) == -1, expected)
    require_share(at_distance(law, 100.0, 0.4) == -1, 0.7)
    sharp = Distance(range=100.0, shadowing=0.01)
    assert [(at_distance(sharp, each) == -1).double().mean() for each in (99.0, 101.0)] == [
        0.0,
        1.0,
    ]
    assert (at_distance(Distance(), 1e6) >= 0).all()


@pytest.mark.parametrize(
    ("law", "dt", "steps"),
    [
        (Distance(), 1.0, 0),
        (Distance(base=1, speed=40.0), 1.0, 4),
        (Distance(speed=50.0), 0.5, 4),
        (Distance(base="0.5s", speed=40.0), 1.0, 3),
        (Distance(base="0.6s", speed=40.0), 1.0, 4),
        (Distance(base=1, speed=5.0, longest=7), 1.0, 7),
        (Distance(speed=20.0, receiver=[100.0, 60.0]), 1.0, 3),
    ],
    ids=str,
)
def test_the_delay_is_the_base_plus_the_distance_over_the_speed_rounded_up(law, dt, steps):
    assert (at_distance(law, 100.0, dt=dt) == steps).all()
