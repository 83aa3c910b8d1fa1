"""Messages between agents do what an obvious program does, which follows one link at a time."""

import math
from dataclasses import dataclass
from itertools import permutations

import pytest
import torch
from delay_twin import Counting, drawn
from environments import vmas
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import step_mdp

from damian import Channel, ContextSampler
from damian.common import counter_rng
from damian.delays.laws import Burst, Law, Trace, Uniform, law_of, sampler_of

N = 3
WORLDS = [3, 5, 8]
STEPS = 25
CLOCKS = 2 * STEPS + 2
ALL = set(permutations(range(N), 2))


class World:
    """Agents that send to each other.

    Args:
        n_agents: number of agents, N.
        delay: delay of what is sent on a link at a clock [steps], None if it is lost.
    """

    def __init__(self, n_agents, delay):
        self.agents = range(n_agents)
        self.delay = delay
        self.clock = 0

    def step(self, contents, wanted, begins=False):
        """Send on the wanted links, and receive."""
        self.clock += 1
        if begins:  # everyone knows everyone's first message
            self.in_transit = []
            self.holds = {
                (i, j): (self.clock, contents[j]) for i in self.agents for j in self.agents
            }
        for link in wanted:
            if (delay := self.delay(self.clock, link)) is not None:
                self.in_transit.append((self.clock + delay, link, self.clock, contents[link[1]]))
        for arrives, link, sent, content in self.in_transit:
            if arrives == self.clock and self.holds[link][0] < sent:
                self.holds[link] = (sent, content)
        self.own = contents

    def seen(self, receiver, sender):
        """Content and age of what a receiver holds of a sender."""
        if receiver == sender:
            return self.own[sender], 0
        sent, content = self.holds[receiver, sender]
        return content, self.clock - sent


def check_against_twin(env, make, wants, forced=lambda _: []):
    """Compare every output of a rollout with partial resets with that of the twins.

    Args:
        env: environment with one ``Channel``.
        make: the twin of a world, given its number and the channel's random streams.
        wants: which links carry a message.
        forced: worlds to reset after a step, beside those that are done.
    """
    torch.manual_seed(0)
    td = env.reset()
    worlds = range(env.batch_size[0])
    twins = [make(b, env.transform[-1].memory["streams"]) for b in worlds]

    def follow(outputs, mask, begins):
        for b in worlds:
            if mask[b]:
                contents = outputs["agents", "observation"][b].tolist()
                twins[b].step(contents, wants(outputs, b), begins)
            assert_same(twins[b], outputs[b])

    follow(td, [True] * len(worlds), begins=True)
    for t in range(STEPS):
        td = env.rand_action(td)
        stepped = env.step(td)
        follow(stepped["next"], [True] * len(worlds), begins=False)
        td = step_mdp(stepped)
        mask = td["done"].view(-1).tolist()
        mask = [done or b in forced(t) for b, done in enumerate(mask)]
        if any(mask):
            td = env.reset(td.set("_reset", torch.tensor(mask).unsqueeze(-1)))
            follow(td, mask, begins=True)


def assert_same(twin, outputs):
    """The messages that each agent has received from each other one are those of the twin."""
    got = [outputs["agents", name].tolist() for name in ("received", "received_age")]
    for i in twin.agents:
        for j in twin.agents:
            assert tuple(part[i][j] for part in got) == twin.seen(i, j), (i, j)


def table(law, streams, n_steps, loss=0.0):
    """The delay that a law draws at a clock for a row; None if the message is lost."""
    sampler = sampler_of(law_of(law), loss=loss)
    delays = drawn(sampler, streams, n_steps).tolist()
    return lambda clock, row: None if (d := delays[clock - 1][row]) == sampler.lost else d


def counting(channel, **options):
    channel.set_seed(1)
    return TransformedEnv(Counting(WORLDS, N, **options), Compose(channel))


def everyone(*_):
    return ALL


def twin_of(law, loss=0.0):
    """Makes twins whose links all have one law."""

    def make(b, streams):
        delays = table(law, streams, CLOCKS, loss)

        def delay(clock, link):
            return delays(clock, b * N * N + link[0] * N + link[1])

        return World(N, delay)

    return make


@pytest.mark.parametrize(
    "law",
    [
        0,
        2,
        Uniform(1, 4),
        Burst(
            0.3,
            0.4,
            good=Uniform(0, 2),
            bad=5,
        ),
    ],
)
def test_messages_arrive_as_their_law_says(law):
    check_against_twin(counting(Channel(law, loss=0.2)), twin_of(law, 0.2), everyone)


def test_a_flag_chooses_who_sends():
    channel = Channel(
        Uniform(0, 3),
        sent_key="message_sent",
        loss=0.1,
    )

    def wants(outputs, b):
        sent = outputs["agents", "message_sent"][b]
        return {(i, j) for i, j in ALL if sent[j]}

    check_against_twin(counting(channel), twin_of(Uniform(0, 3), 0.1), wants)


def test_every_link_may_have_a_law_and_a_loss_of_its_own(tmp_path):
    file = tmp_path / "trace.csv"
    file.write_text("\n".join(["delay", *"140203", "lost", "6"]))
    burst = Burst(0.3, 0.4, good=Uniform(0, 2), bad=5)
    trace = Trace(str(file))
    laws = [[None, 3, burst], [trace, None, 3], [Uniform(0, 4), burst, None]]
    losses = [[0.0, 0.3, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 1.0]]
    losses[2][1] = 0.5

    def make(b, streams):
        tables = {link: table(laws[link[0]][link[1]], streams, CLOCKS) for link in ALL}

        def delay(clock, link):
            row = b * N * N + link[0] * N + link[1]
            draw = counter_rng.uniform(streams[row], torch.tensor(clock), torch.tensor(3))
            return None if draw < losses[link[0]][link[1]] else tables[link](clock, row)

        return World(N, delay)

    check_against_twin(counting(Channel(laws, loss=losses)), make, everyone)


@dataclass(frozen=True)
class Slow(Law):
    """A step per 0.3 m between sender and receiver; messages over more than 1.5 m are lost."""

    def sampler(self, dt=1.0, loss=0.0, key="delay"):
        return ContextSampler(self.delays, 9, loss, reads=["position", "receiver_position"])

    def delays(self, context):
        between = context.entries["position"] - context.entries["receiver_position"]
        metres = torch.linalg.vector_norm(between, dim=-1)
        return torch.where(metres > 1.5, -1, (metres / 0.3).floor())


def place(outputs, b, agent):
    return outputs["agents", "observation"][b, agent, :2].tolist()


@pytest.fixture
def navigation():
    def make(channel):
        channel.set_seed(1)
        return TransformedEnv(vmas(len(WORLDS), N, max_steps=9), Compose(channel))

    return make


def some_worlds(t):
    return [t % len(WORLDS)] if t % 4 == 1 else []


def test_agents_hear_only_those_in_their_range(navigation):
    env = navigation(Channel(Uniform(1, 5), comm_range=0.9, position_key="observation"))
    heard = []

    def wants(outputs, b):
        links = {
            (i, j) for i, j in ALL if math.dist(place(outputs, b, i), place(outputs, b, j)) <= 0.9
        }
        heard.append(len(links))
        return links

    check_against_twin(env, twin_of(Uniform(1, 5)), wants, forced=some_worlds)
    assert 0 < sum(heard) < len(ALL) * len(heard)


def test_a_law_may_read_the_positions_of_sender_and_receiver(navigation):
    env = navigation(Channel(Slow(), position_key="observation"))
    now = {}

    def make(b, _):
        def delay(clock, link):
            metres = math.dist(*(place(now["outputs"], b, agent) for agent in link))
            return None if metres > 1.5 else min(math.floor(metres / 0.3), 9)

        return World(N, delay)

    def wants(outputs, b):
        now["outputs"] = outputs
        return ALL

    check_against_twin(env, make, wants, forced=some_worlds)
