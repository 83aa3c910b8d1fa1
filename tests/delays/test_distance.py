"""The law ``Distance``: delays and losses by the distance of sender and receiver, beside a plain twin."""

import math
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from delayed_envs import choices as uav_choices
from helpers import all_same, everything, play, square
from torch import Tensor
from transform_cases import ACTION, OBSERVATION, REWARD, choices, delayed

from damian.common import counter_rng
from damian.common.errors import InputError
from damian.delays.config import DelayConfig
from damian.delays.laws import Distance, Held, Lag, law_of
from damian.delays.samplers import MessageContext
from damian.envs.clocks import ClockConfig
from damian.envs.pipeline import make_env
from damian.envs.scenario import ScenarioConfig
from damian.transforms import ActionDelay, ObservationDelay, RewardDelay

SENDERS = 20_000


def delay_of(law: Distance, distance: float, uniform: float, dt: float, base: float, longest: int) -> int:
    """Delay of one message in steps, in plain Python; -1 if it is lost, by the normal distribution."""
    if distance > 0 and law.range < math.inf:
        decibels = 10 * law.path_loss_exponent * math.log10(law.range / distance)
        lost = (1 - math.erf(decibels / law.shadowing / math.sqrt(2))) / 2
        if uniform < lost:
            return -1
    return min(math.ceil(base + distance / law.speed / dt - 1e-4), longest)


def context_of(distance: float | Tensor, receiver: Tensor | None = None, dt: float = 1.0) -> MessageContext:
    """A context of messages sent at this distance east of the origin."""
    east = torch.as_tensor(distance).expand(SENDERS)
    uniform = counter_rng.uniform(counter_rng.world_seeds(3, SENDERS), torch.tensor(1))
    entries = {"position": torch.stack([east, torch.zeros_like(east)], -1)}
    entries |= {} if receiver is None else {"receiver_position": receiver}
    zero = torch.zeros(SENDERS, dtype=torch.long)
    return MessageContext(zero, zero - 1, zero + 1, zero.float(), uniform, dt, entries)


def draw(law: Distance, context: MessageContext, loss: float = 0.0) -> Tensor:
    """Delays of these messages [M], -1 for a lost one."""
    sampler, streams = law.sampler(context.dt, loss), counter_rng.world_seeds(3, SENDERS)
    delay, _ = sampler(streams, torch.tensor(1), torch.zeros_like(streams), context)
    return torch.where(delay == sampler.lost, -1, delay)


def lost_share(law: Distance, distance: float, loss: float = 0.0) -> float:
    return (draw(law, context_of(distance), loss) == -1).double().mean().item()


DEVIATION = math.sqrt(0.25 / SENDERS)


def test_half_of_the_messages_are_lost_at_the_range_and_more_beyond_it():
    law = Distance(range=100.0, path_loss_exponent=3.0, shadowing=8.0)
    assert abs(lost_share(law, 100.0) - 0.5) < 5 * DEVIATION
    shares = [lost_share(law, distance) for distance in (0.0, 10.0, 50.0, 80.0, 120.0, 200.0, 1000.0)]
    assert shares == sorted(shares)
    assert shares[0] == 0
    assert shares[-1] > 0.99
    expected = 0.5 * math.erfc(30 * math.log10(100 / 80) / 8 / math.sqrt(2))  # 30 dB per decade
    assert abs(lost_share(law, 80.0) - expected) < 5 * DEVIATION


def test_a_small_shadowing_makes_the_range_sharp_and_an_infinite_range_loses_nothing():
    sharp = Distance(range=100.0, shadowing=0.01)
    assert [lost_share(sharp, distance) for distance in (99.0, 101.0)] == [0.0, 1.0]
    assert lost_share(Distance(), 1e6) == 0
    assert not Distance(speed=3.0).sampler().loses


def test_losses_of_the_transform_add_to_those_of_the_distance():
    assert abs(lost_share(Distance(range=100.0), 100.0, 0.4) - 0.7) < 5 * DEVIATION
    assert abs(lost_share(Distance(), 100.0, 0.4) - 0.4) < 5 * DEVIATION


@pytest.mark.parametrize(
    ("law", "dt", "steps"),
    [
        (Distance(), 1.0, 0),
        (Distance(base=2), 1.0, 2),
        (Distance(speed=40.0), 1.0, 3),
        (Distance(speed=50.0), 0.5, 4),
        (Distance(base="0.5s", speed=40.0), 1.0, 3),
        (Distance(base="0.6s", speed=40.0), 1.0, 4),
        (Distance(base=1, speed=5.0, longest=7), 1.0, 7),
        (Distance(speed=20.0, receiver=[100.0, 60.0]), 1.0, 3),
    ],
    ids=str,
)
def test_the_delay_is_the_base_plus_the_distance_over_the_speed_rounded_up(law, dt, steps):
    assert (draw(law, context_of(100.0, dt=dt)) == steps).all()


def test_the_place_of_the_receiver_in_the_context_replaces_that_of_the_settings():
    place = torch.tensor([[100.0, -40.0]]).expand(SENDERS, 2)
    assert (draw(Distance(speed=10.0), context_of(100.0, place)) == 4).all()


@pytest.mark.parametrize("delay", [ObservationDelay, ActionDelay, RewardDelay])
def test_a_transform_with_a_key_for_it_offers_the_place_of_the_receiver(delay):
    key = {ObservationDelay: [OBSERVATION], ActionDelay: ACTION, RewardDelay: REWARD}[delay]
    position = {"position": "observation"}
    for law in (Distance(speed=1.0), Held(Distance(speed=1.0))):
        for offered in (position, position | {"receiver_position": "observation"}):
            transform = delay(law, key, context_keys=offered)
            assert set(transform.contexts.keys) == set(offered)


def test_a_message_from_the_place_of_the_receiver_is_not_late():
    keys = {"position": "observation", "receiver_position": "observation"}
    law = Distance(speed=0.1, longest=9)
    env = delayed(ObservationDelay(law, [OBSERVATION], delay_key="delay", context_keys=keys), ends=0.0)
    assert not any(td["agents", "delay"].any() for td in play(env, choices(n_steps=4)))


LAW = {
    "law": "distance",
    "base": "0.5s",
    "speed": 40,
    "range": 90,
    "path_loss_exponent": 3,
    "shadowing": 4,
    "receiver": [30, -40],
    "longest": 5,
}


def test_in_a_scenario_each_message_is_as_late_as_the_twin_says():
    delay = DelayConfig(obs=LAW, act={"law": "distance", "speed": 30}, rew={"law": "distance", "base": 1})
    env = make_env(everything("polynomial", delay=delay, clock=ClockConfig("2s")), 4, extras=["message"])
    env.reset()
    streams = next(t.memory["streams"] for t in env.transform if isinstance(t, ObservationDelay))
    outputs, law, seen = play(env, uav_choices(env, 30))[1::2], law_of(LAW), set()
    for clock, td in enumerate(outputs, 1):
        uniform = counter_rng.uniform(streams, torch.tensor(clock)).view(4, 3).tolist()
        entries = (td["agents", name].tolist() for name in ("position", "message_sent", "delay"))
        position, sent, found = entries
        for w, n in ((w, n) for w in range(4) for n in range(3) if sent[w][n]):
            expected = delay_of(law, math.dist(position[w][n], (30, -40)), uniform[w][n], 2.0, 0.25, 5)
            assert found[w][n] == [expected]
            seen.add(expected)
    assert {-1, 1, 2} <= seen


@pytest.mark.slow
def test_a_compiled_environment_delays_the_same():
    scenario = square(delay=DelayConfig(obs=LAW, loss=0.1))
    eager, compiled = (make_env(scenario, 4, seed=5, extras=["message"]) for _ in range(2))
    compiled.compile(backend="eager")
    one, other = (play(env, uav_choices(eager, 12)) for env in (eager, compiled))
    assert all_same(one, other)


def test_worker_processes_can_pickle_its_sampler():
    law = law_of(LAW)
    copied = pickle.loads(pickle.dumps(law.sampler(2.0)))
    assert (copied.reads, copied.optional_reads) == (("position",), ("receiver_position",))


# Mistakes.


def refused(make: Callable[[], Any]) -> str:
    """The one line with which it is refused."""
    with pytest.raises(InputError) as caught:
        make()
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("settings", "error"),
    [
        ({"base": -1}, "base: -1 is neither whole steps"),
        ({"base": 21}, "base: 21 is longer than longest=20"),
        ({"speed": 0}, "speed: 0 m/s is not above 0 m/s"),
        ({"speed": math.nan}, "speed: nan m/s is not above 0 m/s"),
        ({"range": "far"}, "range: far m is not above 0 m"),
        ({"path_loss_exponent": 0}, "path_loss_exponent: 0 is not above 0"),
        ({"shadowing": 0}, "shadowing: 0 dB is not above 0 dB"),
        ({"receiver": [1, 2, 3]}, "receiver: [1, 2, 3] is not [x, y] in metres"),
        ({"longest": 2.5}, "longest: 2.5 is neither whole steps"),
        ({"reach": 3}, "reach: 3 is no setting of the law distance, which has base, speed, range,"),
    ],
    ids=str,
)
def test_an_invalid_setting_is_refused_with_one_line(settings, error):
    delay = DelayConfig(obs={"law": "distance", **settings})
    assert refused(lambda: ScenarioConfig(delay=delay)).startswith(f"delay.obs.{error}")


def test_where_it_makes_no_sense_it_is_refused():
    assert "no reward may be lost" in refused(lambda: DelayConfig(rew=LAW).check(1.0))
    assert "which a lag does not know" in refused(lambda: Lag(Distance()).sampler())
    assert "has no key for position" in refused(lambda: ObservationDelay(Distance()))
