"""Delay laws that see the context of a message: who sends, from where, how many at once, and when."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from context_law import LONGEST, Crowd, twin_delay
from delay_twin import Counting, Purse, Receiver
from delayed_envs import choices as uav_choices
from helpers import everything, play, square
from torch import Tensor
from torchrl.envs import GymEnv, TransformedEnv
from transform_cases import (
    ACTION,
    N_AGENTS,
    OBSERVATION,
    REWARD,
    ROWS,
    STEPS,
    WORLDS,
    after,
    before,
    choices,
    column,
    delayed,
)

from damian.common import counter_rng
from damian.common.errors import InputError
from damian.delays.config import DelayConfig
from damian.delays.laws import Burst, Law, law_of
from damian.delays.samplers import ContextSampler, MessageContext, Sampler
from damian.envs.pipeline import make_env
from damian.envs.scenario import ScenarioConfig
from damian.keys import POSITION
from damian.transforms import ActionDelay, ObservationDelay, RewardDelay

DT = 2.0
SEEN = {"context_keys": {"seen": "observation"}, "dt": DT}
LAW = Crowd("seen", column=4)


@dataclass(frozen=True)
class Of(Law):
    """A law with any function of the context."""

    delay_fn: Callable[[MessageContext], Any]
    options: dict[str, Any] = field(default_factory=dict)

    def sampler(self, dt: float = 1.0, loss: float = 0.0, key: str = "delay") -> Sampler:
        return ContextSampler(self.delay_fn, 5, loss, **self.options)


def uniforms(streams: Tensor, n_steps: int = STEPS) -> list[list[float]]:
    """The random numbers of the messages in steps 1 to T, [T][M]."""
    return [counter_rng.uniform(streams, torch.tensor(t)).tolist() for t in range(1, n_steps + 1)]


# Beside the twin in plain Python; episodes of the worlds end at random, so that some are reset and some not.


def test_messages_are_as_late_as_the_twin_says():
    transform = ObservationDelay(
        LAW, [OBSERVATION], [("agents", "held")], delay_key="delay", sent_key="message_sent", **SEEN
    )
    outputs = play(delayed(transform), choices())
    observed, sent = column(outputs, *OBSERVATION), column(outputs, "agents", "message_sent")
    held, found = column(outputs, "agents", "held"), column(outputs, "agents", "delay")
    done, uniform, seen = column(outputs, "done"), uniforms(transform.memory["streams"]), set()
    for row, (w, n) in enumerate(ROWS):
        receiver, elapsed = Receiver("generation"), 0
        receiver.begin(0, observed[0][w][n])
        for now in range(1, STEPS + 1):
            at, elapsed = 2 * now - 1, elapsed + 1
            value, n_sending = observed[at][w][n][4], sum(sent[at][w])
            delay = twin_delay(value, n_sending, n, elapsed, uniform[now - 1][row])
            delay = delay if sent[at][w][n] else None
            receiver.step(now, observed[at][w][n], delay)
            assert found[at][w][n] == [-1 if delay is None else delay]
            assert held[at][w][n] == receiver.holds.content
            seen.add((n_sending, delay))
            if done[at][w][0]:
                elapsed = 0
                receiver.begin(now, observed[at + 1][w][n])
    assert len(seen) > 10


def test_actions_are_as_late_as_the_twin_says():
    default = 5
    transform, chosen = ActionDelay(LAW, ACTION, sent_key="ready", default=default, **SEEN), choices()
    outputs = play(delayed(transform), chosen)
    seen, ready = before(outputs, *OBSERVATION), before(outputs, "agents", "ready")
    observed, done, uniform = (
        after(outputs, *OBSERVATION),
        after(outputs, "done"),
        uniforms(transform.memory["streams"]),
    )
    for row, (w, n) in enumerate(ROWS):
        receiver, elapsed = Receiver("generation"), 0
        receiver.begin(0, default)
        for t in range(STEPS):
            delay = twin_delay(seen[t][w][n][4], sum(ready[t][w]), n, elapsed, uniform[t][row])
            receiver.step(t + 1, chosen[t][w, n].item(), delay if ready[t][w][n] else None)
            assert observed[t][w][n][5] == receiver.holds.content
            elapsed += 1
            if done[t][w][0]:
                elapsed = 0
                receiver.begin(t + 1, default)


def test_rewards_are_as_late_as_the_twin_says_and_none_is_lost():
    earned = after(play(Counting(WORLDS, N_AGENTS), choices()), *REWARD)
    transform = RewardDelay(Crowd("seen", column=4, loses=False), REWARD, **SEEN)
    outputs = play(delayed(transform), choices())
    seen, received, done = after(outputs, *OBSERVATION), after(outputs, *REWARD), after(outputs, "done")
    uniform = uniforms(transform.memory["streams"])
    for row, (w, n) in enumerate(ROWS):
        purse, elapsed = Purse(), 0
        for t in range(STEPS):
            elapsed += 1
            delay = twin_delay(seen[t][w][n][4], N_AGENTS, n, elapsed, uniform[t][row]) or 0
            ended = done[t][w][0]
            assert received[t][w][n][0] == purse.step(t, earned[t][w][n][0], delay, ended)
            elapsed = 0 if ended else elapsed


def test_in_a_scenario_a_law_reads_the_true_position_at_the_instant_of_sending():
    scenario = everything("polynomial", delay=DelayConfig(obs=Crowd()))
    env = make_env(scenario, 4, extras=["message"])
    td, generator = env.reset(), torch.Generator().manual_seed(1)
    streams = [stream for name, stream in env.state_dict().items() if name.endswith("streams")]
    uniform, elapsed, numbers = uniforms(streams[0], 25), [0] * 4, set()
    for t, action in enumerate(uav_choices(env, 25)):
        stepped, td = env.step_and_maybe_reset(td.set(ACTION, action))
        found, truth = stepped["next"], stepped["next", "agents", "position"]
        ended = found["done"].view(-1)
        state = env.uav_env.state
        place = state.position[..., :2] + env.uav_env.simulation.airspace.offset[state.region].unsqueeze(1)
        assert truth[~ended].equal(place[~ended])
        sent = found["agents", "message_sent"].tolist()
        for w in range(4):
            elapsed[w] += 1
            for n in range(3):
                value, row = truth[w, n, 0].item(), 3 * w + n
                delay = twin_delay(value, sum(sent[w]), n, elapsed[w], uniform[t][row])
                expected = -1 if delay is None or not sent[w][n] else delay
                assert found["agents", "delay"][w, n].item() == expected
            numbers.add(sum(sent[w]))
        reset = torch.rand(4, 1, generator=generator) < 0.1
        td = env.reset(td.set("_reset", reset)) if reset.any() else td
        elapsed = [0 if r or e else k for r, e, k in zip(reset.view(-1), ended, elapsed, strict=True)]
    assert numbers == {0, 1, 2, 3}


def test_without_a_law_that_reads_it_no_position_is_output():
    for law in (3, Of(lambda context: context.n_sending)):
        env = make_env(square(delay=DelayConfig(obs=law, act=law)), 2)
        assert POSITION not in env.rollout(3).keys(True)


def test_a_single_agent_is_the_only_sender_of_its_world():
    contexts = []

    def note(context: MessageContext) -> Tensor:
        contexts.append(context)
        return context.n_sending

    law = Of(note, {"reads": ["pole"]})
    options = {"dt": 0.5, "context_keys": {"pole": "observation"}}
    env = TransformedEnv(
        GymEnv("CartPole-v1"), ObservationDelay(law, ["observation"], ["late"], **options, seed=1)
    )
    rollout = env.rollout(6, break_when_any_done=False)
    for t, context in enumerate(contexts[1:], 1):  # the first one is the trial at the reset
        numbers = context.sender, context.receiver, context.n_sending, context.time
        assert [value.tolist() for value in numbers] == [[0], [-1], [1], [0.5 * t]]
        assert context.dt == 0.5
        assert context.entries["pole"].equal(rollout["next", "observation"][t - 1 : t])
    assert len(contexts) == 7
    assert rollout["next", "late"][1:].equal(rollout["observation"][1:])


# Samplers.


def context_of(uniform: Tensor) -> MessageContext:
    """A context of messages about which nothing but a random number is known."""
    zero = torch.zeros_like(uniform).long()
    return MessageContext(zero, zero - 1, zero + 1, zero.float(), uniform, 1.0, {})


@pytest.mark.parametrize(("loses", "expected"), [(True, [6, 5, 6, 3, 5, 0]), (False, [0, 5, 0, 3, 5, 0])])
def test_delays_are_rounded_up_and_cut_and_negative_ones_are_lost(loses, expected):
    values = torch.tensor([math.nan, math.inf, -0.5, 2.1, 99.0, 0.0])
    sampler = ContextSampler(lambda _: values, 5, loses=loses)
    delay, _ = sampler(torch.arange(6), torch.tensor(1), torch.zeros(6), context_of(torch.rand(6)))
    assert delay.tolist() == expected
    assert (sampler.longest, sampler.lost, sampler.certain, sampler.loses) == (5, 6, None, loses)


def test_the_rounding_errors_of_a_float_cost_no_step():
    senders = torch.tensor([7, 14, 17, 19])
    delays = senders * 0.3 / 0.1  # in float32: 21.000002, 42.000004, ...
    assert (delays.ceil() > 3 * senders).any()
    for values, expected in ((delays, 3 * senders), (delays.round() + 0.001, 3 * senders + 1)):
        sampler = ContextSampler(lambda _, values=values: values, 100)
        delay, _ = sampler(senders, torch.tensor(1), senders, context_of(torch.rand(4)))
        assert delay.equal(expected)


def test_losses_whatever_the_delay_do_not_depend_on_the_random_number_of_the_context():
    sampler = ContextSampler(lambda context: (context.uniform < 0.5).long(), 1, loss=0.3, loses=False)
    streams, clock = counter_rng.world_seeds(5, 40_000), torch.tensor(3)
    uniform = counter_rng.uniform(streams, clock)
    delay, _ = sampler(streams, clock, torch.zeros_like(streams), context_of(uniform))
    assert sampler.loses
    for some in (uniform < 0.5, uniform >= 0.5):
        share = (delay[some] == sampler.lost).double().mean().item()
        assert abs(share - 0.3) < 5 * math.sqrt(0.3 * 0.7 / 20_000)


def test_a_held_law_loses_the_same_messages_and_delays_the_others_equally():
    free, held = (
        play(env := make_env(everything(delay=delay), 4, extras=["message"]), uav_choices(env, 20))
        for delay in (DelayConfig(obs=Crowd()), DelayConfig(obs=Crowd(), hold="max"))
    )
    one, other = (torch.stack([td["agents", "delay"] for td in outputs[1::2]]) for outputs in (free, held))
    assert other.equal(torch.where(one == -1, -1, LONGEST))
    assert (one == -1).any()
    certain = DelayConfig(obs=Crowd(loses=False), hold="max").uplink.sampler()
    assert (certain.certain, certain.loses) == (LONGEST, False)


def test_lists_of_a_setting_arrive_as_plain_lists_of_numbers():
    law = law_of({"law": "constant", "delay": ("1", ["2", 3.5])})
    assert law.delay == [1, [2, 3.5]]


# Mistakes.


def refused(make: Callable[[], Any]) -> str:
    """The one line with which it is refused."""
    with pytest.raises(InputError) as caught:
        make()
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("delay", [ObservationDelay, ActionDelay, RewardDelay])
def test_a_law_that_reads_what_has_no_key_is_refused_at_construction(delay):
    law = Crowd(loses=False)
    expected = "has no key for position, which the law Crowd reads"
    assert refused(lambda: delay(law)) == f"context_keys: {{}} {expected}"
    keys = {"place": "observation"}
    assert refused(lambda: delay(law, context_keys=keys)) == f"context_keys: {keys} {expected}"


@pytest.mark.parametrize(
    ("delay_fn", "found"),
    [
        (lambda context: 3, "int"),
        (lambda context: context.time.view(-1, 1), "a tensor of torch.float32 and shape (8, 1)"),
        (lambda context: context.time[:1], "a tensor of torch.float32 and shape (1,)"),
        (lambda context: context.uniform < 0.5, "a tensor of torch.bool and shape (8,)"),
    ],
)
@pytest.mark.parametrize("delay", [ObservationDelay, ActionDelay, RewardDelay])
def test_a_function_that_does_not_return_a_delay_for_each_message_is_refused_at_the_reset(
    delay, delay_fn, found
):
    key = {ObservationDelay: [OBSERVATION], ActionDelay: ACTION, RewardDelay: REWARD}[delay]
    message = refused(delayed(delay(Of(delay_fn, {"loses": False}), key)).reset)
    assert message == f"<lambda>: {found} is not one number of steps per message, shape (8,)"


def test_an_entry_that_is_missing_or_has_other_rows_is_refused():
    env = delayed(ObservationDelay(LAW, [OBSERVATION], context_keys={"seen": "speed"}))
    assert refused(env.reset) == "context_keys.seen: ('agents', 'speed') is missing from the TensorDict"
    transform = ObservationDelay(LAW, [OBSERVATION], **SEEN)
    delayed(transform).reset()
    entries = {OBSERVATION: torch.zeros(8, 7)}
    message = refused(lambda: transform.contexts.read(transform.memory, entries, None, transform.rows))
    assert message.endswith("has shape (8, 7), but messages are sent by rows of shape (4, 2)")


def test_a_name_that_is_not_declared_cannot_be_read():
    law = Of(lambda context: context.entries["speed"])
    message = refused(delayed(ObservationDelay(law, [OBSERVATION])).reset)
    expected = "the context has no entry speed: the sampler declares those that it has, reads=[]"
    assert message == f"law test_context:Of: {expected}"


def test_a_step_without_what_the_law_reads_is_refused():
    env = delayed(ActionDelay(LAW, ACTION, **SEEN))
    td = env.rand_action(env.reset()).exclude(OBSERVATION)
    expected = "context_keys.seen: ('agents', 'observation') is missing from the TensorDict"
    assert refused(lambda: env.step(td)) == expected


def test_where_a_law_with_context_makes_no_sense_it_is_refused():
    problem = "depends on the context of the message, which a burst does not know"
    assert problem in refused(lambda: Burst(bad=Crowd()).sampler(key="delay.obs"))
    assert "no reward may be lost" in refused(lambda: DelayConfig(rew=Crowd()).check(1.0))
    assert "no reward may be lost" in refused(lambda: RewardDelay(LAW, **SEEN))
    message = refused(lambda: ScenarioConfig(delay=DelayConfig(act=Crowd("altitude"))))
    assert message.endswith("reads altitude, but a law can read only position")
    assert message.startswith("delay.act: ")
    assert refused(lambda: ContextSampler(len, 3, reads="position")).startswith("reads: position is not a")
    for chances in ([0.7, 0.7], [-0.1, 1.0], [math.nan]):
        expected = f"chances of the delays: {chances} are not at least 0 and at most 1 in all"
        assert refused(lambda chances=chances: Sampler([chances])) == expected
    assert refused(lambda: ContextSampler(len, 2.5)) == "longest: 2.5 steps is not a whole number"
    with pytest.raises(ValueError, match="context: it is missing"):
        ContextSampler(len, 3)(torch.arange(2), torch.tensor(1), torch.zeros(2))
