"""The law ``Lag``: delays that are held, beside a slow twin in plain Python, and how often they change."""

import copy
import dataclasses
import math
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from context_law import Crowd
from delay_twin import Counting, Purse, Receiver, drawn
from delayed_envs import choices as uav_choices
from helpers import all_same, play, square
from torch import Tensor
from transform_cases import (
    ACTION,
    N_AGENTS,
    OBSERVATION,
    REWARD,
    ROWS,
    STEPS,
    WORLDS,
    after,
    choices,
    column,
    delayed,
    trace,
)

import damian
from damian.common import counter_rng
from damian.common.errors import InputError
from damian.delays.config import DelayConfig
from damian.delays.laws import Burst, Constant, Geometric, Held, Lag, Law, Uniform, law_of
from damian.delays.samplers import Sampler
from damian.envs.pipeline import make_env
from damian.envs.scenario import ScenarioConfig
from damian.transforms import ActionDelay, ObservationDelay, RewardDelay

LAW = Uniform(1, 5)
LAGS = {
    "each message": Lag(LAW),
    "period": Lag(LAW, 3),
    "time": Lag(LAW, "4s"),
    "episode": Lag(LAW, "episode"),
    "hold": Lag(LAW, 2, hold_probability=0.5),
    "shared": Lag(LAW, 3, shared=True),
    "stagger": Lag(LAW, 4, stagger=True),
    "all": Lag(LAW, 3, hold_probability=0.4, shared=True, stagger=True),
}
every_lag = pytest.mark.parametrize("lag", LAGS.values(), ids=LAGS)


class Sender:
    """Delays of one sender's messages, in plain Python."""

    def __init__(self, stream: int, lag: Lag, loss: float = 0.0) -> None:
        self.stream, self.lag, self.loss = torch.tensor(stream), lag, loss
        self.period = {"episode": math.inf, "4s": 4}.get(str(lag.update_period), lag.update_period)
        self.begin()

    def begin(self) -> None:
        """Begin an episode."""
        self.held, self.update_at = None, 0

    def bits(self, *counters: int) -> int:
        return int(counter_rng.bits(self.stream, *map(torch.tensor, counters)))

    def share(self, *counters: int) -> float:
        return float(counter_rng.uniform(self.stream, *map(torch.tensor, counters)))

    def send(self, now: int) -> int | None:
        """The delay of the message that is sent at this step; None if it is lost."""
        drawn = 1 + 5 * self.bits(now) // 2**32
        if self.held is None:
            self.held = drawn
            self.update_at = now + (1 + self.bits(now, 2) % self.period if self.lag.stagger else self.period)
        elif now == self.update_at:
            self.update_at = now + self.period
            if self.share(now, 1) >= self.lag.hold_probability:
                self.held = drawn
        return None if self.share(now, 0) < self.loss else self.held


def senders(transform: Any, lag: Lag, loss: float = 0.0) -> list[Sender]:
    """A sender for each row, with the random stream of the transform."""
    return [Sender(stream, lag, loss) for stream in transform.memory["streams"].tolist()]


# Beside the twin; the episodes of the worlds end at random steps.


@pytest.mark.sample(2)
@every_lag
@pytest.mark.parametrize(
    ("order", "loss", "sent_key"), [("generation", 0.0, None), ("arrival", 0.25, "message_sent")]
)
def test_messages_are_as_late_as_the_twin_says(lag, order, loss, sent_key):
    options = {"loss": loss, "order": order, "sent_key": sent_key, "delay_key": "delay"}
    transform = ObservationDelay(lag, [OBSERVATION], [("agents", "seen")], **options)
    outputs = play(delayed(transform), choices())
    observed, message_sent = column(outputs, *OBSERVATION), column(outputs, "agents", "message_sent")
    seen, found = column(outputs, "agents", "seen"), column(outputs, "agents", "delay")
    done = column(outputs, "done")
    for sender, (w, n) in zip(senders(transform, lag, loss), ROWS, strict=True):
        receiver = Receiver(order)
        receiver.begin(0, observed[0][w][n])
        for now in range(1, STEPS + 1):
            at = 2 * now - 1
            delay = sender.send(now)
            delay = delay if sent_key is None or message_sent[at][w][n] else None
            receiver.step(now, observed[at][w][n], delay)
            assert found[at][w][n] == [-1 if delay is None else delay]
            assert seen[at][w][n] == receiver.holds.content
            if done[at][w][0]:
                receiver.begin(now, observed[at + 1][w][n])
                sender.begin()


@every_lag
def test_actions_are_as_late_as_the_twin_says(lag):
    transform, chosen = ActionDelay(lag, ACTION, default=5, loss=0.2), choices()
    outputs = play(delayed(transform), chosen)
    observed, done = after(outputs, *OBSERVATION), after(outputs, "done")
    for sender, (w, n) in zip(senders(transform, lag, 0.2), ROWS, strict=True):
        receiver = Receiver("generation")
        receiver.begin(0, 5)
        for t in range(STEPS):
            receiver.step(t + 1, chosen[t][w, n].item(), sender.send(t + 1))
            assert observed[t][w][n][5] == receiver.holds.content
            if done[t][w][0]:
                receiver.begin(t + 1, 5)
                sender.begin()


@every_lag
def test_rewards_are_as_late_as_the_twin_says_and_none_is_lost(lag):
    transform = RewardDelay(lag, REWARD)
    earned = after(play(Counting(WORLDS, N_AGENTS), choices()), *REWARD)
    outputs = play(delayed(transform), choices())
    received, done = after(outputs, *REWARD), after(outputs, "done")
    for sender, (w, n) in zip(senders(transform, lag), ROWS, strict=True):
        purse = Purse()
        for t in range(STEPS):
            ended = done[t][w][0]
            assert received[t][w][n][0] == purse.step(t, earned[t][w][n][0], sender.send(t + 1), ended)
            if ended:
                sender.begin()


def one_of_each(lag: Lag) -> list[Any]:
    return [
        ActionDelay(lag, ACTION, loss=0.1),
        ObservationDelay(lag, [OBSERVATION], loss=0.1),
        RewardDelay(lag, REWARD),
    ]


@pytest.mark.parametrize("name", ["episode", "stagger", "all"])
def test_a_world_alone_has_the_same_lags_as_in_a_batch(name):
    batch = play(delayed(*one_of_each(LAGS[name])), choices(n_steps=20))
    for w, world in enumerate(WORLDS):
        alone = play(delayed(*one_of_each(LAGS[name]), worlds=[world]), choices([world], 20))
        assert all_same([td[w : w + 1] for td in batch], alone)


@every_lag
def test_a_copy_and_a_loaded_state_go_on_with_the_same_lags(lag):
    env = delayed(*one_of_each(lag))
    play(env, choices(n_steps=9))
    copied, loaded = copy.deepcopy(env), delayed(*one_of_each(lag))
    play(loaded, choices(n_steps=4))
    loaded.base_env.__dict__.update(copy.deepcopy(env.base_env).__dict__)
    loaded.transform.load_state_dict(copy.deepcopy(env.transform.state_dict()))
    runs = []
    for each in (env, copied, loaded):
        steps = [each.step(each.rand_action().set(ACTION, action))["next"] for action in choices(n_steps=9)]
        runs.append(steps)
    assert all_same(*runs[:2])
    assert all_same(*runs[1:])


SCENARIO = {
    "obs": {"law": "lag", "lag": {"law": "uniform", "high": 4}, "update_period": "2s", "stagger": True},
    "act": Lag(Uniform(0, 2), "episode", shared=True),
    "rew": Lag(Geometric(1, 4), 2, hold_probability=0.5),
    "loss": 0.1,
}


@pytest.mark.slow
def test_a_compiled_environment_has_the_same_lags():
    scenario = square(delay=DelayConfig(**SCENARIO))
    eager, compiled = (make_env(scenario, 4, seed=5, extras=["message"]) for _ in range(2))
    compiled.compile(backend="eager")
    one, other = (play(env, uav_choices(eager, 20)) for env in (eager, compiled))
    assert all_same(one, other)


# Samplers: how often lags change.


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


# Samplers: losses.


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


# Settings.


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


def test_a_lag_of_0_is_the_identity():
    lag = Lag(Uniform(0, 3, probability=0.0), 3, hold_probability=0.5, shared=True, stagger=True)
    transforms = [ActionDelay(lag, ACTION), ObservationDelay(lag, [OBSERVATION]), RewardDelay(lag, REWARD)]
    plain = play(Counting(WORLDS, N_AGENTS), choices())
    found = play(delayed(*transforms), choices())
    assert all_same([td.exclude(("agents", "age")) for td in found], plain)


def test_a_lag_can_be_written_as_a_mapping():
    inner = {"law": "uniform", "low": 1, "high": 5}
    law = law_of({"law": "lag", "lag": inner, "update_period": "episode", "shared": True})
    assert law == Lag(inner, "episode", shared=True)
    assert law_of({"law": "lag", "lag": "3s", "update_period": "2"}) == Lag("3s", 2)
    assert sample(law, 50, 9).equal(sample(Lag(LAW, "episode"), 50, 9))
    pickle.loads(pickle.dumps(law.sampler()))


@pytest.mark.parametrize("name", ["lag", "distance"])
def test_the_package_has_a_configuration_with_the_law(name):
    written = yaml.safe_load((Path(damian.__file__).parents[1] / f"conf/delay/{name}.yaml").read_text())
    delay = DelayConfig(**written)
    delay.check(1.0)
    assert delay.obs["law"] == name


def refused(make: Callable[[], Any]) -> str:
    """The one line with which it is refused."""
    with pytest.raises(InputError) as caught:
        make()
    assert "\n" not in str(caught.value)
    return str(caught.value)


NO_PERIOD = "is neither whole steps such as 3, nor a time such as 3s, nor episode"
NO_EFFECT = "has no effect with update_period=episode, which draws one lag per episode"


@pytest.mark.parametrize("name", ["obs", "act", "rew"])
@pytest.mark.parametrize(
    ("settings", "error"),
    [
        ({"hold_probability": 1.5}, "hold_probability: 1.5 is not between 0 and 1"),
        ({"hold_probability": 0.5, "shared": "yes"}, "shared: yes is not one of True, False"),
        ({"stagger": 3}, "stagger: 3 is not one of True, False"),
        ({"update_period": 0}, "update_period: 0 is not above 0"),
        ({"update_period": "0s"}, "update_period: 0s is not above 0"),
        ({"update_period": -1}, "update_period: -1 is neither whole steps"),
        ({"update_period": "epoch"}, f"update_period: epoch {NO_PERIOD}"),
        ({"update_period": "episodes"}, f"update_period: episodes {NO_PERIOD}"),
        ({"update_period": None}, "update_period: None is neither whole steps"),
        ({"update_period": "episode", "stagger": True}, f"stagger: True {NO_EFFECT}"),
        ({"update_period": "episode", "hold_probability": 0.5}, f"hold_probability: 0.5 {NO_EFFECT}"),
        ({"lag": -1}, "lag: -1 is neither whole steps"),
        ({"lag": {"law": "gauss"}}, "lag.law: gauss is not one of"),
        ({"lag": {"law": "burst"}}, "lag: {'law': 'burst'} is not a memoryless law"),
        ({"lag": {"law": "lag"}}, "lag: {'law': 'lag'} is not a memoryless law"),
        ({"period": 3}, "period: 3 is no setting of the law lag, which has lag, update_period, hold_"),
    ],
    ids=str,
)
def test_an_invalid_setting_is_refused_with_one_line(name, settings, error):
    delay = DelayConfig(**{name: {"law": "lag", "lag": 3, **settings}})
    assert refused(lambda: ScenarioConfig(delay=delay)).startswith(f"delay.{name}.{error}")


def test_laws_with_memory_or_context_are_refused_as_inner_laws(tmp_path):
    with_memory = [trace(tmp_path, 1, 2), Lag(LAW, 2), Held(Lag(LAW)), Held(trace(tmp_path, 1, 2))]
    for law in with_memory:
        assert refused(lambda law=law: Lag(law).sampler()).endswith("is not a memoryless law")
        assert refused(lambda law=law: Burst(bad=law).sampler()).endswith("is not a memoryless law")
    problem = "depends on the context of the message, which a lag does not know"
    assert refused(lambda: Lag(Crowd()).sampler()).endswith(problem)
    for law in (Constant(2), Held(LAW), Held(Uniform(0, 2))):
        Lag(law).sampler()
        Burst(bad=law).sampler()
