"""One line for each kind of mistake in a delay law, a trace, or a setting of delays."""

import math

import pytest
import torch
from context_law import Crowd
from transform_cases import ACTION, OBSERVATION, delayed, trace

from damian.common.errors import InputError
from damian.delays.config import DelayConfig, LinkConfig, check_laws
from damian.delays.laws import LONGEST, Burst, Constant, Held, Lag, Uniform
from damian.delays.samplers import ContextSampler, Sampler
from damian.transforms import ActionDelay, ObservationDelay, RewardDelay

STEPS_OR_TIME = "is neither whole steps such as 3 nor a time such as 3s"

INVALID_LAWS = [
    (-1, f": -1 {STEPS_OR_TIME}"),
    (1.5, f": 1.5 {STEPS_OR_TIME}"),
    (None, f": None {STEPS_OR_TIME}"),
    ("3.5", f": 3.5 {STEPS_OR_TIME}"),
    ("xs", ": xs is not a time such as 2s"),
    ("3h", f": 3h is more than {LONGEST} steps"),
    ("uniform", ": uniform is no delay; that law is written {law: uniform}"),
    ({"law": "gauss"}, ".law: gauss is not one of constant, uniform, geometric, burst, trace"),
    ({"law": "uniform", "lo": 3}, ".lo: 3 is no setting of the law uniform, which has low, high, pro"),
    ({"law": "uniform", "low": 4, "high": 2}, ".low: 4 and high=2 are not two steps or two times"),
    ({"law": "uniform", "low": 2, "high": "4s"}, ".low: 2 and high=4s are not two steps or two times"),
    ({"law": "uniform", "high": 2, "probability": 1.5}, ".probability: 1.5 is not between 0 and 1"),
    ({"law": "geometric", "mean": "far"}, f".mean: far {STEPS_OR_TIME}"),
    ({"law": "burst", "enter": 0, "leave": 0}, ".enter + leave: 0 is not above 0"),
    ({"law": "burst", "bad": {"law": "burst"}}, ".bad: {'law': 'burst'} is not a memoryless law"),
    ({"law": "trace"}, ".path: it is missing: the file with the delays"),
    ({"law": "lag", "update_period": 0}, ".update_period: 0 is not above 0"),
    ({"law": "lag", "update_period": "epoch"}, ".update_period: epoch is not a time"),
    ({"law": "lag", "update_period": "episode", "stagger": True}, ".stagger: True has no effect with upd"),
    ({"law": "distance", "base": 21}, ".base: 21 is longer than longest=20"),
    ({"law": "distance", "speed": math.nan}, ".speed: nan m/s is not above 0 m/s"),
    ({"law": "distance", "receiver": [1, 2, 3]}, ".receiver: [1, 2, 3] is not [x, y] in metres"),
]


@pytest.mark.parametrize(("setting", "error"), INVALID_LAWS, ids=lambda value: str(value)[:50])
def test_an_invalid_law_raises_one_line_that_names_its_key(setting, error):
    for name in ("obs", "act", "rew"):
        with pytest.raises(InputError) as caught:
            check_laws(DelayConfig(**{name: setting}), 1.0)
        assert str(caught.value).startswith(f"delay.{name}{error}")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("settings", "error"),
    [
        ({"loss": 2}, "delay.loss: 2 is not between 0 and 1"),
        ({"order": "newest"}, "delay.order: newest is not one of generation, arrival"),
        ({"history": 2.5}, "delay.history: 2.5 is not a whole number"),
        ({"reward_window": 0}, "delay.reward_window: 0 steps is not between 1 and 10000 steps"),
        ({"reward_discount": math.nan}, "delay.reward_discount: nan is not above 0"),
    ],
    ids=str,
)
def test_an_invalid_delay_setting_raises_an_error_that_names_its_key(settings, error):
    with pytest.raises(InputError) as caught:
        DelayConfig(**settings)
    assert str(caught.value) == error


@pytest.mark.parametrize(
    ("settings", "error"),
    [
        ({"kind": "ring"}, "links.kind: ring is not one of"),
        ({"delay": 3}, "links.delay: 3 means nothing with links=server"),
        ({"kind": "matrix", "range": 50.0, "hears": [[True]]}, "links.range: 50.0 does not go with links.he"),
        (
            {"kind": "matrix", "delay": [[0, 1], [1, 0]]},
            "links.delay: it is not 3 lists (receivers) of 3 entries",
        ),
        (
            {"kind": "matrix", "loss": [[0, 0, 0], [0, 0, 2], [0, 0, 0]]},
            "links.loss[1][2]: 2 is not between 0 and 1",
        ),
        (
            {"kind": "matrix", "hears": [[1, 1, 1]] * 3},
            "links.hears[0][0]: 1 is not a list of true and false",
        ),
    ],
    ids=str,
)
def test_an_invalid_setting_of_links_raises_an_error_that_names_its_key(settings, error):
    with pytest.raises(InputError) as caught:
        LinkConfig(**settings).check(3)
    assert str(caught.value).startswith(error)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("when,late\n1,2\n", "line 1: no column delay"),
        ("delay\n", "line 2: there is no delay under the header"),
        ("delay\n2\n\n3\n-1\n", "line 5: delay: -1"),
        (None, "no such file"),
    ],
)
def test_an_invalid_trace_raises_one_line_that_names_the_file_and_the_line(tmp_path, text, error):
    file = tmp_path / "trace.csv"
    if text is not None:
        file.write_text(text)
    with pytest.raises(InputError) as caught:
        check_laws(DelayConfig(obs={"law": "trace", "path": str(file)}), 1.0)
    assert str(caught.value).startswith(f"{file}: {error}")


@pytest.mark.parametrize("user", [Lag, lambda law: Burst(bad=law)], ids=["lag", "burst"])
def test_a_law_with_memory_or_context_is_refused_as_an_inner_law(user, tmp_path):
    for law in (trace(tmp_path, 1, 2), Held(Lag(Uniform(1, 5)))):
        with pytest.raises(InputError, match="is not a memoryless law"):
            user(law).sampler()
    with pytest.raises(InputError, match="depends on the context of the message"):
        user(Crowd()).sampler()
    user(Held(Uniform(0, 2))).sampler()


def test_losses_are_refused_where_a_reward_would_be_lost():
    for make in (lambda: check_laws(DelayConfig(rew={"law": "burst"}), 1.0), lambda: RewardDelay(Burst())):
        with pytest.raises(InputError, match="no reward may be lost"):
            make()


def test_probabilities_that_are_none_are_refused():
    for chances in ([0.7, 0.7], [-0.1, 1.0], [math.nan]):
        with pytest.raises(InputError, match=r"chances of the delays: .* at most 1 in all"):
            Sampler([chances])
    with pytest.raises(InputError, match="loss: nan is not between 0 and 1"):
        Constant(1).sampler(loss=math.nan)


def test_a_law_that_reads_what_there_is_not_is_refused():
    with pytest.raises(InputError, match="has no key for position, which the law Crowd reads"):
        ObservationDelay(Crowd())
    with pytest.raises(InputError, match=r"delay.act: .* reads altitude, but a law can read only position"):
        check_laws(DelayConfig(act=Crowd("altitude")), 1.0)
    with pytest.raises(InputError, match="reads: position is not a list of names"):
        ContextSampler(len, 3, reads="position")
    env = delayed(ActionDelay(Crowd("seen"), ACTION, context_keys={"seen": "speed"}))
    with pytest.raises(InputError, match=r"context_keys.seen: .* is not among the keys"):
        env.reset()


@pytest.mark.parametrize("delay_fn", [lambda c: 3, lambda c: c.time[:1], lambda c: c.uniform < 0.5])
def test_a_function_that_does_not_return_a_delay_for_each_message_is_refused(delay_fn):
    class Wrong(Crowd):
        def delays(self, context):
            return delay_fn(context)

    env = delayed(ObservationDelay(Wrong("seen"), [OBSERVATION], context_keys={"seen": "observation"}))
    with pytest.raises(InputError, match=r"is not one number of steps per message, \[8\]"):
        env.rollout(1)


def test_a_sampler_of_contexts_needs_one():
    with pytest.raises(ValueError, match="context: it is missing"):
        ContextSampler(len, 3)(torch.arange(2), torch.tensor(1), torch.zeros(2))
