"""Late messages, actions and rewards beside senders in plain Python, whose episodes end at random
steps."""

import math
import runpy
from pathlib import Path

import pytest
import torch
from delay_twin import (
    ACTION,
    LAWS as TABLES,
    LONGEST,
    N_AGENTS,
    OBSERVATION,
    REWARD,
    ROWS,
    STEPS,
    WORLDS,
    Counting,
    Crowd,
    Purse,
    Receiver,
    after,
    before,
    choices,
    column,
    delayed,
    drawn,
    twin_delay,
)
from delayed_envs import choices as uav_choices
from helpers import everything, play

from damian import ActionDelay, DelayConfig, Lag, ObservationDelay, RewardDelay, Uniform, make_env
from damian.common import counter_rng

Route = runpy.run_path(str(Path(__file__).parents[2] / "examples/extending/law.py"))["Route"]
DT = 2.0
LAWS = {
    "each message": Lag(Uniform(1, 5)),
    "time": Lag(Uniform(1, 5), "8s"),
    "episode": Lag(Uniform(1, 5), "episode"),
    "hold": Lag(Uniform(1, 5), 2, hold_probability=0.5),
    "all": Lag(
        Uniform(1, 5),
        3,
        hold_probability=0.4,
        shared=True,
        stagger=True,
    ),
    "context": Crowd("seen", column=4),
    "state of one's own": Route(4, change=0.6),
}
"""Laws that hold delays, read contexts, or keep a state of their own; ``TABLES`` have the
others."""


@pytest.fixture(params=[*TABLES, *LAWS])
def law(request, tmp_path):
    return LAWS[request.param] if request.param in LAWS else TABLES[request.param](tmp_path)


class LagSender:
    """Delays of one sender's messages by a law ``Lag``."""

    def __init__(self, lag, stream, loss):
        self.stream = torch.tensor(stream)
        self.lag = lag
        self.loss = loss
        self.period = {
            "episode": math.inf,
            "8s": 4,
        }.get(str(lag.update_period), lag.update_period)
        self.begin()

    def begin(self):
        """Begin an episode."""
        self.held = None
        self.update_at = 0

    def bits(self, *counters):
        return int(counter_rng.bits(self.stream, *map(torch.tensor, counters)))

    def share(self, *counters):
        return float(counter_rng.uniform(self.stream, *map(torch.tensor, counters)))

    def send(self, now, value, n_sending):
        """The delay of the message that is sent at this step; None if it is lost."""
        drawn = 1 + 5 * self.bits(now) // 2**32
        if self.held is None:
            self.held = drawn
            self.update_at = now + (
                1 + self.bits(now, 2) % self.period if self.lag.stagger else self.period
            )
        elif now == self.update_at:
            self.update_at = now + self.period
            if self.share(now, 1) >= self.lag.hold_probability:
                self.held = drawn
        return None if self.share(now, 0) < self.loss else self.held


class CrowdSender(LagSender):
    """Delays of one sender's messages by the law ``Crowd``; the first one is sent after so many
    steps."""

    def __init__(self, agent, stream, loss=0.0, first=1):
        self.agent = agent
        self.stream = torch.tensor(stream)
        self.loss = loss
        self.first = first
        self.begin()

    def begin(self):
        self.elapsed = self.first

    def send(self, now, value, n_sending):
        delay = twin_delay(value, n_sending, self.agent, self.elapsed, self.share(now))
        self.elapsed += 1
        return None if self.share(now, 0) < self.loss else delay


class RouteSender(LagSender):
    """Delays of one sender's messages by the law ``Route`` of docs/extending.md."""

    def __init__(self, law, stream, loss):
        self.law = law
        self.stream = torch.tensor(stream)
        self.loss = loss
        self.delay = self.bits() % (law.longest + 1)

    def begin(self):
        """The walk goes on."""

    def send(self, now, value, n_sending):
        draw = self.share(now)
        half = self.law.change / 2
        self.delay = min(max(self.delay + (draw < half) - (draw >= 1 - half), 0), self.law.longest)
        return None if self.share(now, 0) < self.loss else self.delay


class TableSender(LagSender):
    """Delays of one sender's messages as the sampler itself draws them, from ``drawn``."""

    def __init__(self, delays, lost):
        self.delays = [None if delay == lost else delay for delay in delays]

    def begin(self):
        """The draws go on."""

    def send(self, now, value, n_sending):
        return self.delays[now - 1]


def senders(transform, law, loss=0.0, first=1):
    """A sender for each row, with the random stream of the transform."""
    streams = transform.memory["streams"]
    sampler = transform.sampler
    own = {
        Lag: LagSender,
        Route: RouteSender,
        Crowd: CrowdSender,
    }.get(type(law))
    if own is None:
        return [TableSender(d, sampler.lost) for d in drawn(sampler, streams, STEPS).T.tolist()]
    assert len(streams.unique()) >= len(WORLDS), "worlds draw apart"
    pairs = zip(streams.tolist(), ROWS, strict=True)
    return [
        own(n, s, loss, first) if own is CrowdSender else own(law, s, loss) for s, (_, n) in pairs
    ]


def options(law):
    """Arguments of a transform that delays by this law."""
    keys = {"context_keys": {"seen": "observation"}} if isinstance(law, Crowd) else {}
    return keys | {"dt": DT if type(law) in (Lag, Crowd, Route) else 1.0}


@pytest.mark.sample(3)
@pytest.mark.parametrize(
    ("order", "loss", "sent_key"),
    [
        ("generation", 0.0, None),
        ("arrival", 0.25, "message_sent"),
    ],
)
def test_every_agent_holds_the_message_that_the_twin_holds(law, order, loss, sent_key):
    further = {"loss": loss, "order": order, "sent_key": sent_key, "delay_key": "delay"}
    transform = ObservationDelay(
        law, [OBSERVATION], [("agents", "seen")], **further, **options(law)
    )
    outputs = play(delayed(transform), choices())
    observed = column(outputs, *OBSERVATION)
    message_sent = column(outputs, "agents", "message_sent")
    found = {key: column(outputs, "agents", key) for key in ("seen", "age", "delay")}
    done = column(outputs, "done")
    for sender, (w, n) in zip(senders(transform, law, loss), ROWS, strict=True):
        receiver = Receiver(order)
        receiver.begin(0, observed[0][w][n])
        for now in range(1, STEPS + 1):
            at = 2 * now - 1
            reset = 2 * now
            n_sending = sum(message_sent[at][w]) if sent_key else N_AGENTS
            delay = sender.send(now, observed[at][w][n][4], n_sending)
            delay = delay if sent_key is None or message_sent[at][w][n] else None
            receiver.step(now, observed[at][w][n], delay)
            held = receiver.holds
            told = -1 if delay is None else delay
            assert [found[key][at][w][n] for key in found] == [
                held.content,
                [now - held.sent],
                [told],
            ]
            if done[at][w][0]:
                receiver.begin(now, observed[reset][w][n])
                sender.begin()
                assert [found[key][reset][w][n] for key in found] == [
                    observed[reset][w][n],
                    [0],
                    [0],
                ]


@pytest.mark.sample(3)
@pytest.mark.parametrize(
    ("loss", "sent_key", "hold"),
    [
        (0.0, None, False),
        (0.25, "ready", False),
        (0.25, None, True),
    ],
)
def test_every_agent_executes_the_action_that_the_twin_holds(law, loss, sent_key, hold):
    chosen = choices()
    default = 5
    further = {"sent_key": sent_key, "valid_key": "action_valid", "default": default, "loss": loss}
    further["hold"] = hold
    transform = ActionDelay(law, ACTION, **further, **options(law))
    outputs = play(delayed(transform), chosen)
    seen = before(outputs, *OBSERVATION)
    ready = before(outputs, "agents", "ready")
    observed = after(outputs, *OBSERVATION)
    done = after(outputs, "done")
    for sender, (w, n) in zip(senders(transform, law, loss, first=0), ROWS, strict=True):
        receiver = Receiver("generation")
        receiver.begin(0, default)
        for t in range(STEPS):
            delay = sender.send(t + 1, seen[t][w][n][4], sum(ready[t][w]) if sent_key else N_AGENTS)
            if hold and delay is not None:
                delay = transform.sampler.longest
            sent = sent_key is None or ready[t][w][n]
            fresh = receiver.step(t + 1, chosen[t][w, n].item(), delay if sent else None)
            assert observed[t][w][n][5:] == [receiver.holds.content, fresh or receiver.waits]
            if done[t][w][0]:
                receiver.begin(t + 1, default)
                sender.begin()


@pytest.mark.sample(3)
def test_every_agent_receives_the_rewards_of_the_twin_and_none_is_lost(law):
    law = (
        Crowd(
            "seen",
            column=4,
            loses=False,
        )
        if isinstance(law, Crowd)
        else law
    )
    earned = after(play(Counting(WORLDS, N_AGENTS), choices()), *REWARD)
    transform = RewardDelay(
        law, REWARD, delay_key="reward_delay", earned_key="earned", **options(law)
    )
    outputs = play(delayed(transform), choices())
    seen = after(outputs, *OBSERVATION)
    received = after(outputs, *REWARD)
    done = after(outputs, "done")
    reported, known = (after(outputs, "agents", name) for name in ("reward_delay", "earned"))
    assert known == earned
    assert received == after(
        play(delayed(RewardDelay(law, REWARD, **options(law))), choices()), *REWARD
    )
    for sender, (w, n) in zip(senders(transform, law), ROWS, strict=True):
        purse = Purse()
        in_transit = 0.0
        for t in range(STEPS):
            delay = sender.send(t + 1, seen[t][w][n][4], N_AGENTS) or 0
            reward = earned[t][w][n][0]
            ended = done[t][w][0]
            assert reported[t][w][n] == [delay]
            assert received[t][w][n][0] == purse.step(t, reward, delay, ended)
            in_transit += reward - received[t][w][n][0]
            assert not ended or in_transit == 0
            if ended:
                sender.begin()


def test_in_a_scenario_a_law_reads_the_true_position_at_the_instant_of_sending():
    env = make_env(everything("polynomial", delay=DelayConfig(obs=Crowd())), 4, extras=["message"])
    td = env.reset()
    numbers = set()
    stream = next(stream for name, stream in env.state_dict().items() if name.endswith("streams"))
    people = [CrowdSender(row % 3, each) for row, each in enumerate(stream.tolist())]
    for now, action in enumerate(uav_choices(env, 25), 1):
        stepped, td = env.step_and_maybe_reset(td.set(ACTION, action))
        found = stepped["next"]
        truth = stepped["next", "agents", "position"]
        ended = found["done"].view(-1)
        state = env.uav_env.state
        place = state.position[..., :2] + env.uav_env.simulation.airspace.offset[
            state.region
        ].unsqueeze(1)
        assert truth[~ended].equal(place[~ended])
        sent = found["agents", "message_sent"].tolist()
        for row, sender in enumerate(people):
            w, n = divmod(row, 3)
            delay = sender.send(now, truth[w, n, 0].item(), sum(sent[w]))
            expected = -1 if delay is None or not sent[w][n] else delay
            assert found["agents", "delay"][w, n].item() == expected
            numbers.add(sum(sent[w]))
            if ended[w]:
                sender.begin()
    assert numbers == {0, 1, 2, 3}


def test_a_held_law_loses_the_same_messages_and_delays_the_others_equally():
    free, held = (
        play(env := make_env(everything(delay=delay), 4, extras=["message"]), uav_choices(env, 20))
        for delay in (DelayConfig(obs=Crowd()), DelayConfig(obs=Crowd(), hold="max"))
    )
    one, other = (
        torch.stack([td["agents", "delay"] for td in outputs[1::2]]) for outputs in (free, held)
    )
    assert other.equal(torch.where(one == -1, -1, LONGEST))
    assert (one == -1).any()
