"""The law ``Lag``: delays that are held, beside a slow twin in plain Python, and its settings."""

import copy
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
from damian.delays.laws import Burst, Constant, Geometric, Held, Lag, Uniform, law_of
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


# Settings.


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
    streams = counter_rng.world_seeds(5, 50)
    assert drawn(law.sampler(), streams, 9).equal(drawn(Lag(LAW, "episode").sampler(), streams, 9))
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
