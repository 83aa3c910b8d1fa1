"""Reference implementations of delays in plain Python, for one agent at a time.

``Counting`` is a small environment in which every observation tells its world, agent, step and episode.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from damian.common import counter_rng
from damian.delays.samplers import Sampler


def drawn(sampler: Sampler, streams: Tensor, n_steps: int) -> Tensor:
    """Delays of the messages that senders with these random streams [M] send in steps 1 to T, [T, M]."""
    memory, delays = sampler.initial_state(streams), []
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
    """Receives the messages of one sender, and holds one of them.

    Args:
        order: hold the message that was sent last (``generation``) or that arrived last (``arrival``).
    """

    def __init__(self, order: str) -> None:
        self.order = order

    def begin(self, now: int, content: Any) -> None:
        """Begin an episode: the first message is received without delay, and no other is in transit."""
        self.began, self.holds, self.in_transit = now, Message(now, now, content), []

    def step(self, now: int, content: Any, delay: int | None) -> bool:
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
    def waits(self) -> bool:
        """Has no message of this episode arrived but the first."""
        return self.holds.sent == self.began


@dataclass
class Purse:
    """Delayed rewards of one agent."""

    in_transit: list[tuple[int, float]] = field(default_factory=list)
    """Step of arrival and value of each reward."""

    def step(self, now: int, reward: float, delay: int, done: bool) -> float:
        """Delay a reward; return the sum of those that arrive now, or of all of them if the episode ends."""
        self.in_transit.append((now + delay, reward))
        arrived = [entry for entry in self.in_transit if done or entry[0] == now]
        self.in_transit = [entry for entry in self.in_transit if entry not in arrived]
        return sum(reward for _, reward in arrived)


def looking_back(rewards: Sequence[float], steps: int, gamma: float) -> float:
    """Cumulative reward (paper, eq. 4) at the latest of an episode's rewards so far."""
    last = len(rewards) - 1
    return sum(gamma ** (last - t) * rewards[t] for t in range(max(last - steps + 1, 0), last + 1))


def last_actions(actions: Sequence[Any], steps: int, default: Any) -> list[Any]:
    """The latest actions of an episode so far, oldest first."""
    return [*[default] * steps, *actions][-steps:]


class Counting(EnvBase):
    """An environment in which every observation tells where it comes from; episodes end at random.

    Each agent's state x becomes 3 x + a + 1 (mod 101) when it executes the action a. Its observation is
    [world, agent, steps since construction, episode, x, executed action, ``action_valid``], its reward
    x + 100 * world.

    Args:
        worlds: integer names of the worlds; what a world does depends on its name, but on no other world.
        n_agents: number of agents in each world, N.
        continuous: actions are two numbers in [-1, 3], which are rounded to an integer, instead of integers.
        ends: probability that an episode ends in a step.
        tampered: (world, agent, step) whose observation and reward are falsified.
    """

    N_ACTIONS = 7

    def __init__(
        self,
        worlds: Sequence[int],
        n_agents: int = 2,
        continuous: bool = False,
        ends: float = 0.15,
        tampered: tuple[int, int, int] | None = None,
    ) -> None:
        super().__init__(batch_size=[len(worlds)])
        self.names, self.n_agents, self.ends, self.tampered = torch.tensor(worlds), n_agents, ends, tampered
        self.total = 0
        worlds_shape, agents = self.batch_size, torch.Size((len(worlds), n_agents))

        def group(**specs: Any) -> Composite:
            return Composite(agents=Composite(**specs, shape=agents), shape=worlds_shape)

        action = Categorical(self.N_ACTIONS, shape=agents)
        if continuous:
            action = Bounded(-1.0, 3.0, shape=(*agents, 2))
        flag = Binary(shape=agents, n=n_agents, dtype=torch.bool)
        observation = Unbounded((*agents, 7), dtype=torch.float64)
        self.action_spec = group(action=action)
        self.observation_spec = group(observation=observation, message_sent=flag, ready=flag.clone())
        self.reward_spec = group(reward=Unbounded((*agents, 1)))
        self._begin(torch.ones(worlds_shape, dtype=torch.bool))
        self.episode = torch.zeros(worlds_shape, dtype=torch.long)

    def _begin(self, mask: Tensor) -> None:
        shape = (*self.batch_size, self.n_agents)
        x = (7 * self.names.unsqueeze(-1) + torch.arange(self.n_agents)) % 101
        self.x = torch.where(mask.unsqueeze(-1), x, self.x if hasattr(self, "x") else x)
        self.executed, self.action_valid = torch.zeros(shape), torch.ones(shape)

    def _flag(self, salt: int) -> Tensor:
        """A flag that is true with probability 2/3, [B, N]."""
        agents = torch.arange(self.n_agents)
        return (
            counter_rng.bits(self.names.unsqueeze(-1), agents, torch.tensor([2 * self.total + salt])) % 3 > 0
        )

    def _outputs(self) -> TensorDict:
        shape = (*self.batch_size, self.n_agents)
        names, agents = self.names.unsqueeze(-1).expand(shape), torch.arange(self.n_agents).expand(shape)
        total, episode = torch.full(shape, self.total), self.episode.unsqueeze(-1).expand(shape)
        observation = torch.stack(
            [names, agents, total, episode, self.x, self.executed, self.action_valid], -1
        ).double()
        falsified = torch.zeros(shape, dtype=torch.bool)
        if self.tampered is not None and self.tampered[2] == self.total:
            falsified[self.tampered[:2]] = True
        observation = observation - falsified.unsqueeze(-1) * 1000.0
        values = {"observation": observation, "message_sent": self._flag(0), "ready": self._flag(1)}
        self.falsified = falsified
        return TensorDict({"agents": TensorDict(values, shape)}, self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones(self.batch_size, dtype=torch.bool) if mask is None else mask.view(-1)
        self._begin(mask)
        self.episode = self.episode + mask
        return self._outputs().set("done", torch.zeros(*self.batch_size, 1, dtype=torch.bool))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.total += 1
        action = tensordict["agents", "action"]
        if action.is_floating_point():
            action = (action * action.new_tensor([1.0, 10.0])).round().sum(-1)
        self.x = (3 * self.x + action.long() + 1) % 101
        self.executed = action
        self.action_valid = tensordict.get(("agents", "action_valid"), self.action_valid)
        outputs = self._outputs()
        reward = (self.x + 100 * self.names.unsqueeze(-1) - 1000 * self.falsified).float()
        outputs["agents"].set("reward", reward.unsqueeze(-1))
        done = counter_rng.uniform(self.names, torch.tensor(self.total)) < self.ends
        return outputs.set("done", done.unsqueeze(-1)).set("terminated", done.unsqueeze(-1))

    def _set_seed(self, seed: int | None) -> None:
        """The random numbers depend only on the worlds' names and the step."""
