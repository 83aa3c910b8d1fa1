"""The law ``Lag``: how often its delays change, and which messages it loses."""

import dataclasses
import math

import pytest
import torch
from delay_twin import drawn
from helpers import play
from torch import Tensor
from transform_cases import (
    ACTION,
    N_AGENTS,
    OBSERVATION,
    REWARD,
    ROWS,
    WORLDS,
    choices,
    delayed,
)

from damian.common import counter_rng
from damian.delays.laws import Geometric, Held, Lag, Law, Uniform
from damian.delays.samplers import Sampler
from damian.transforms import ActionDelay, ObservationDelay, RewardDelay

LAW = Uniform(1, 5)


def sample(lag: Lag, n_senders: int, n_steps: int, loss: float = 0.0) -> Tensor:
    """Delays of one episode, [T, M]."""
    return drawn(lag.sampler(loss=loss), counter_rng.world_seeds(5, n_senders), n_steps)


def require_share(found: Tensor, expected: float) -> None:
    """Is the share of true flags as expected, within five standard deviations of a binomial distribution?"""
    deviation = math.sqrt(expected * (1 - expected) / found.numel())
    assert abs(found.double().mean().item() - expected) < 5 * deviation


def test_without_holding_the_lags_are_the_delays_of_the_other_law():
    for law in (LAW, Geometric(2, 6), Uniform("3s", "7s", 0.15)):
        assert sample(Lag(law), 500, 50).equal(drawn(law.sampler(), counter_rng.world_seeds(5, 500), 50))


@pytest.mark.parametrize("probability", [0.0, 0.3, 0.95])
def test_an_update_keeps_the_lag_with_the_hold_probability(probability):
    delays = sample(Lag(Uniform(0, 999), 2, hold_probability=probability), 2000, 41)
    kept = delays[1:] == delays[:-1]
    assert kept[::2].all()
    require_share(kept[1::2], probability + (1 - probability) / 1000)


def test_the_first_lag_is_always_drawn():
    delays = sample(Lag(Uniform(0, 9), hold_probability=1.0), 4000, 5)
    assert delays.equal(delays[:1].expand_as(delays))
    for steps in range(10):
        require_share(delays[0] == steps, 0.1)


def test_staggered_senders_update_at_times_spread_evenly_over_the_period():
    period = 5
    changed = sample(Lag(Uniform(0, 9999), period, stagger=True), 5000, 26).diff(dim=0) != 0
    first = changed[:period].int().argmax(0)  # 0: in the step after the first
    for phase in range(period):
        require_share(first == phase, 1 / period)
    due = torch.arange(25).unsqueeze(-1) % period == first
    assert changed[~due].double().mean() < 0.001  # the first update may have drawn the same lag again
    assert changed[due].double().mean() > 0.999


def test_without_stagger_all_senders_update_in_the_same_step():
    changed = sample(Lag(Uniform(0, 9999), 5), 50, 26).diff(dim=0) != 0
    assert (changed.any(1).nonzero().flatten() + 1).tolist() == [5, 10, 15, 20, 25]


def test_staggered_senders_draw_a_new_phase_in_each_episode():
    sampler, streams = Lag(Uniform(0, 9999), 5, stagger=True).sampler(), counter_rng.world_seeds(5, 4000)
    state, clock = sampler.initial_state(streams), torch.tensor(1)
    _, state = sampler(streams, clock, state)
    begun = sampler.begin_episode(state, torch.arange(4000) < 2000)
    assert begun[2000:].equal(state[2000:])
    _, again = sampler(streams, clock + 1, begun)
    require_share(again[:2000, 1] == state[:2000, 1], 1 / 5)


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("make", [ObservationDelay, ActionDelay, RewardDelay])
def test_the_agents_of_a_world_have_the_same_lags_exactly_if_they_share_them(make, shared):
    key = {ObservationDelay: [OBSERVATION], ActionDelay: ACTION, RewardDelay: REWARD}[make]
    transform = make(Lag(LAW, shared=shared), key)
    play(delayed(transform), choices(n_steps=2))
    streams = transform.memory["streams"].view(len(WORLDS), N_AGENTS)
    assert (streams == streams[:, :1]).all() == shared
    assert len(set(streams.flatten().tolist())) == (len(WORLDS) if shared else len(ROWS))


def test_agents_that_share_a_lag_also_lose_the_same_messages():
    for law in (Lag(LAW, 3, shared=True), Held(Lag(LAW, 3, shared=True))):
        transform = ObservationDelay(law, [OBSERVATION], loss=0.4, delay_key="delay")
        delay = torch.stack([td["agents", "delay"] for td in play(delayed(transform), choices())[1::2]])
        assert delay[..., 0, :].equal(delay[..., 1, :])
        assert (delay == -1).any()
        assert not delay[:, 0].equal(delay[:, 1])


@dataclasses.dataclass(frozen=True)
class Lossy(Law):
    """A law of one's own that loses some messages itself."""

    chances: tuple[float, ...] = (0.25, 0.25)

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        return Sampler([[*self.chances]], loss=loss)


@pytest.mark.parametrize(("law", "loss"), [(Uniform(0, 1), 0.5), (Lossy(), 0.0), (Lossy((0.4, 0.4)), 0.375)])
def test_losses_are_drawn_for_each_message_and_lags_are_held(law, loss):
    lag = Lag(law, "episode")
    delays = sample(lag, 2000, 20, loss)
    lost = delays == lag.sampler().lost
    require_share(lost, 0.5)
    require_share(lost[1:] & lost[:-1], 0.25)
    ones = (delays == 1).any(0)
    require_share(ones, 0.5)
    assert not (ones & (delays == 0).any(0)).any()


def test_a_law_that_loses_every_message_stays_one():
    for lag, loss in ((Lag(Lossy((0.0,))), 0.0), (Lag(LAW), 1.0)):
        assert (sample(lag, 10, 10, loss) == lag.sampler().lost).all()


def test_a_held_lag_loses_the_same_messages_and_delays_the_others_equally():
    free, held = sample(Lag(LAW, 3), 100, 30, 0.3), sample(Held(Lag(LAW, 3)), 100, 30, 0.3)
    assert held.equal(torch.where(free == 6, 6, 5))


def test_a_sampler_knows_whether_its_delay_is_certain_and_whether_it_loses_messages():
    for lag, loss, expected in (
        (Lag(0, "episode", shared=True), 0.0, (0, 0, False)),
        (Lag("3s", 2, stagger=True), 0.0, (3, 3, False)),
        (Lag(3), 0.1, (3, None, True)),
        (Lag(LAW), 0.0, (5, None, False)),
        (Lag(Lossy()), 0.0, (1, None, True)),
    ):
        sampler = lag.sampler(loss=loss)
        assert (sampler.longest, sampler.certain, sampler.loses) == expected
