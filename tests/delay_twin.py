"""Delays in plain Python, for one agent at a time, and the laws and environments on which they are
tested.

``Counting`` is a small environment in which every observation tells its world, agent, step and
episode.
"""

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, TransformedEnv

from damian import Burst, ContextSampler, Geometric, Law, Trace, Uniform
from damian.common import counter_rng

LONGEST = 6
LOST = 0.875
"""Random number from which on a message is lost."""


@dataclass(frozen=True)
class Crowd(Law):
    """Delays by sender, number of senders, time, a random number, and a column of an entry."""

    entry: str = "position"
    """Name of the entry."""
    column: int = 0
    """Column of the entry that the law looks at."""
    loses: bool = True

    def sampler(self, dt=1.0, loss=0.0, key="delay"):
        return ContextSampler(
            self.delays,
            LONGEST,
            loss,
            loses=self.loses,
            reads=[self.entry],
        )

    def delays(self, context):
        """Every part is a whole number, apart from a quarter that is to be rounded up."""
        place = (context.entries[self.entry][:, self.column] / 32).floor().abs() % 3
        parity = (context.time / context.dt) % 2
        steps = (
            place
            + context.n_sending
            + context.sender
            + parity
            + (4 * context.uniform).floor()
            - 0.25
        )
        return torch.where(context.uniform >= LOST, -1.0, steps)


def twin_delay(value, n_sending, sender, elapsed, uniform):
    """The delay of ``Crowd`` for one message; None if it is lost."""
    if uniform >= LOST:
        return None
    place = abs(math.floor(value / 32)) % 3
    return min(
        math.ceil(place + n_sending + sender + elapsed % 2 + math.floor(4 * uniform) - 0.25),
        LONGEST,
    )


def drawn(sampler, streams, n_steps):
    """Delays of the messages that senders with these random streams [M] send in steps 1 to T,
    [T, M]."""
    memory = sampler.initial_state(streams)
    delays = []
    for clock in range(1, n_steps + 1):
        delay, memory = sampler(streams, torch.tensor(clock), memory)
        delays.append(delay)
    return torch.stack(delays)


class Message(NamedTuple):
    """A message in transit, or received."""

    arrives: int
    sent: int
    content: Any


class Receiver:
    """Receives one sender's messages; holds that sent last (``generation``) or arrived last
    (``arrival``)."""

    def __init__(self, order):
        self.order = order

    def begin(self, now, content):
        """Begin an episode: the first message is received without delay, and no other is in
        transit."""
        self.began = now
        self.holds = Message(now, now, content)
        self.in_transit = []

    def step(self, now, content, delay):
        """Send a message, unless the delay is None, and receive others; is a new message held?"""
        if delay is not None:
            self.in_transit.append(Message(now + delay, now, content))
        arrived = [message for message in self.in_transit if message.arrives == now]
        self.in_transit = [message for message in self.in_transit if message.arrives > now]
        newest = max(arrived, key=lambda message: message.sent, default=None)
        if newest is None or (self.order == "generation" and newest.sent < self.holds.sent):
            return False
        self.holds = newest
        return True

    @property
    def waits(self):
        """Has no message of this episode arrived but the first."""
        return self.holds.sent == self.began


@dataclass
class Purse:
    """Delayed rewards of one agent."""

    in_transit: list[tuple[int, float]] = field(default_factory=list)
    """Step of arrival and value of each reward."""

    def step(self, now, reward, delay, done):
        """Delay a reward; return the sum of those that arrive now, or of all of them if the episode
        ends."""
        self.in_transit.append((now + delay, reward))
        arrived = [entry for entry in self.in_transit if done or entry[0] == now]
        self.in_transit = [entry for entry in self.in_transit if entry not in arrived]
        return sum(reward for _, reward in arrived)


class Counting(EnvBase):
    """An environment in which every observation tells where it comes from; episodes end at random.

    Each agent's state x becomes 3 x + a + 1 (mod 101) when it executes the action a. Its
    observation is [world, agent, steps since construction, episode, x, executed action,
    ``action_valid``], its reward x + 100 * world.

    Args:
        worlds: integer names of the worlds; what a world does depends on its name, but on no other
            world.
        n_agents: number of agents in each world, N.
        ends: probability that an episode ends in a step.
    """

    N_ACTIONS = 7

    def __init__(self, worlds, n_agents=2, ends=0.15):
        super().__init__(batch_size=[len(worlds)])
        self.names = torch.tensor(worlds)
        self.n_agents = n_agents
        self.ends = ends
        self.total = 0
        worlds_shape = self.batch_size
        agents = torch.Size((len(worlds), n_agents))

        def group(**specs):
            return Composite(agents=Composite(**specs, shape=agents), shape=worlds_shape)

        flag = Binary(shape=agents, n=n_agents, dtype=torch.bool)
        observation = Unbounded((*agents, 7), dtype=torch.float64)
        self.action_spec = group(action=Categorical(self.N_ACTIONS, shape=agents))
        self.observation_spec = group(
            observation=observation, message_sent=flag, ready=flag.clone()
        )
        self.reward_spec = group(reward=Unbounded((*agents, 1)))
        self._begin(torch.ones(worlds_shape, dtype=torch.bool))
        self.episode = torch.zeros(worlds_shape, dtype=torch.long)

    def _begin(self, mask):
        shape = (*self.batch_size, self.n_agents)
        x = (7 * self.names.unsqueeze(-1) + torch.arange(self.n_agents)) % 101
        self.x = torch.where(mask.unsqueeze(-1), x, self.x if hasattr(self, "x") else x)
        self.executed = torch.zeros(shape)
        self.action_valid = torch.ones(shape)

    def _flag(self, salt):
        """A flag that is true with probability 2/3, [B, N]."""
        agents = torch.arange(self.n_agents)
        bits = counter_rng.bits(
            self.names.unsqueeze(-1), agents, torch.tensor([2 * self.total + salt])
        )
        return bits % 3 > 0

    def _outputs(self):
        shape = (*self.batch_size, self.n_agents)
        names = self.names.unsqueeze(-1).expand(shape)
        agents = torch.arange(self.n_agents).expand(shape)
        total = torch.full(shape, self.total)
        episode = self.episode.unsqueeze(-1).expand(shape)
        observation = torch.stack(
            [names, agents, total, episode, self.x, self.executed, self.action_valid], -1
        ).double()
        values = {
            "observation": observation,
            "message_sent": self._flag(0),
            "ready": self._flag(1),
        }
        return TensorDict({"agents": TensorDict(values, shape)}, self.batch_size)

    def _reset(self, tensordict=None, **_):
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones(self.batch_size, dtype=torch.bool) if mask is None else mask.view(-1)
        self._begin(mask)
        self.episode = self.episode + mask
        return self._outputs().set("done", torch.zeros(*self.batch_size, 1, dtype=torch.bool))

    def _step(self, tensordict):
        self.total += 1
        action = tensordict["agents", "action"]
        self.x = (3 * self.x + action + 1) % 101
        self.executed = action
        self.action_valid = tensordict.get(("agents", "action_valid"), self.action_valid)
        outputs = self._outputs()
        reward = (self.x + 100 * self.names.unsqueeze(-1)).float()
        outputs["agents"].set("reward", reward.unsqueeze(-1))
        done = counter_rng.uniform(self.names, torch.tensor(self.total)) < self.ends
        return outputs.set("done", done.unsqueeze(-1)).set("terminated", done.unsqueeze(-1))

    def _set_seed(self, seed):
        """The random numbers depend only on the worlds' names and the step."""


ACTION = ("agents", "action")
REWARD = ("agents", "reward")
OBSERVATION = ("agents", "observation")
WORLDS = [3, 5, 8, 13]
N_AGENTS = 2
STEPS = 40
ROWS = [(world, agent) for world in range(len(WORLDS)) for agent in range(N_AGENTS)]

PAPER = Uniform("3s", "7s", 0.15)
LAWS = {
    "none": lambda _: 0,
    "constant": lambda _: 3,
    "uniform": lambda _: Uniform(1, 4),
    "paper": lambda _: PAPER,
    "geometric": lambda _: Geometric(2, 6),
    "burst": lambda _: Burst(
        0.2,
        0.3,
        good=Uniform(0, 1),
        bad=5,
        bad_loss=0.0,
    ),
    "trace": lambda folder: trace(folder, 4, 0, 7, 1, 0, 2, 9, 0, 0, 3),
}
"""Delay laws that lose no message."""


def trace(folder, *delays):
    """A trace of these delays, in a file of the folder."""
    file = folder / f"{len(delays)}.csv"
    file.write_text("\n".join(map(str, ["delay", *delays])))
    return Trace(str(file))


def delayed(*transforms, worlds=WORLDS, **options):
    """A ``Counting`` environment with transforms whose draws depend on the names of the worlds."""
    for transform in transforms:
        transform.seed_worlds(torch.tensor(worlds))
    return TransformedEnv(Counting(worlds, N_AGENTS, **options), Compose(*transforms))


def choices(worlds=WORLDS, n_steps=STEPS):
    """Actions for each step, [B, N]; those of a world do not depend on the other worlds."""
    names = torch.tensor(worlds).unsqueeze(-1)
    agents = torch.arange(N_AGENTS)
    return [
        counter_rng.bits(names, agents, torch.tensor([t])) % Counting.N_ACTIONS
        for t in range(n_steps)
    ]


def column(outputs, *key):
    """An entry of every output, as nested lists."""
    return torch.stack([td[key] for td in outputs]).tolist()


def before(outputs, *key):
    """An entry before each step, as nested lists."""
    return column(outputs[:-1:2], *key)


def after(outputs, *key):
    """An entry after each step, as nested lists."""
    return column(outputs[1::2], *key)
