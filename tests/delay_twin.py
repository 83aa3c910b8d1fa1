"""Delays as slow and obvious Python: one receiver, one purse, one clock, one memory at a time.

Beside them stands a small world whose numbers tell where they come from: every observation says which
world, agent, step and episode it was made in.
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
    """Delays of the messages sent at the steps 1, 2, ... by senders with these streams [M], [T, M]."""
    memory, delays = sampler.initial_state(streams), []
    for clock in range(1, n_steps + 1):
        delay, memory = sampler(streams, torch.tensor(clock), memory)
        delays.append(delay)
    return torch.stack(delays)


class Message(NamedTuple):
    """On its way, or there."""

    arrives: int
    sent: int
    content: Any


class Receiver:
    """Holds one message of one sender.

    Args:
        order: believe what was sent last (``generation``) or what came last (``arrival``).
    """

    def __init__(self, order: str) -> None:
        self.order = order

    def begin(self, now: int, content: Any) -> None:
        """A new episode: the first message is there at once, and nothing else is on its way."""
        self.began, self.holds, self.under_way = now, Message(now, now, content), []

    def step(self, now: int, content: Any, delay: int | None) -> bool:
        """A message is sent (None: or lost), others arrive; is what is held new?"""
        if delay is not None:
            self.under_way.append(Message(now + delay, now, content))
        came = [message for message in self.under_way if message.arrives == now]
        self.under_way = [message for message in self.under_way if message.arrives > now]
        newest = max(came, key=lambda message: message.sent, default=None)
        if newest is None or (self.order == "generation" and newest.sent < self.holds.sent):
            return False
        self.holds = newest
        return True

    @property
    def waits(self) -> bool:
        """Has nothing arrived in this episode."""
        return self.holds.sent == self.began


@dataclass
class Purse:
    """Rewards of one agent, paid when they are due."""

    owed: list[tuple[int, float]] = field(default_factory=list)

    def step(self, now: int, reward: float, delay: int, done: bool) -> float:
        """What is paid; everything, when the episode ends."""
        self.owed.append((now + delay, reward))
        due = [debt for debt in self.owed if done or debt[0] == now]
        self.owed = [debt for debt in self.owed if debt not in due]
        return sum(reward for _, reward in due)


def looking_back(rewards: Sequence[float], steps: int, gamma: float) -> float:
    """Eq. 4 at the last of an episode's rewards so far."""
    last = len(rewards) - 1
    return sum(gamma ** (last - t) * rewards[t] for t in range(max(last - steps + 1, 0), last + 1))


def last_actions(actions: Sequence[Any], steps: int, default: Any) -> list[Any]:
    """The latest actions of an episode so far, oldest first."""
    return [*[default] * steps, *actions][-steps:]


class Counting(EnvBase):
    """A deterministic world whose numbers tell where they come from; episodes end at random.

    Its number x goes on by x' = 3 x + a + 1 (mod 101) with the action a that it executes. Shown are, for
    each agent, [world, agent, steps in all, episode, x, action executed, does it act]; the reward is
    x + 100 * world.

    Args:
        worlds: their names, integers; alone, a world does what it does among others.
        n_agents: N.
        continuous: actions are two numbers in [-1, 3], which count rounded.
        ends: chance that an episode ends in a step.
        tampered: (world, agent, step) whose observation and reward lie.
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
        seen = Unbounded((*agents, 7), dtype=torch.float64)
        self.action_spec = group(action=action)
        self.observation_spec = group(observation=seen, message_sent=flag, ready=flag.clone())
        self.reward_spec = group(reward=Unbounded((*agents, 1)))
        self._begin(torch.ones(worlds_shape, dtype=torch.bool))
        self.episode = torch.zeros(worlds_shape, dtype=torch.long)

    def _begin(self, mask: Tensor) -> None:
        shape = (*self.batch_size, self.n_agents)
        x = (7 * self.names.unsqueeze(-1) + torch.arange(self.n_agents)) % 101
        self.x = torch.where(mask.unsqueeze(-1), x, self.x if hasattr(self, "x") else x)
        self.executed, self.action_valid = torch.zeros(shape), torch.ones(shape)

    def _flag(self, salt: int) -> Tensor:
        """A flag that is true two times out of three, [B, N]."""
        agents = torch.arange(self.n_agents)
        return (
            counter_rng.bits(self.names.unsqueeze(-1), agents, torch.tensor([2 * self.total + salt])) % 3 > 0
        )

    def _show(self) -> TensorDict:
        shape = (*self.batch_size, self.n_agents)
        names, agents = self.names.unsqueeze(-1).expand(shape), torch.arange(self.n_agents).expand(shape)
        total, episode = torch.full(shape, self.total), self.episode.unsqueeze(-1).expand(shape)
        seen = torch.stack(
            [names, agents, total, episode, self.x, self.executed, self.action_valid], -1
        ).double()
        lies = torch.zeros(shape, dtype=torch.bool)
        if self.tampered is not None and self.tampered[2] == self.total:
            lies[self.tampered[:2]] = True
        seen = seen - lies.unsqueeze(-1) * 1000.0
        values = {"observation": seen, "message_sent": self._flag(0), "ready": self._flag(1)}
        self.lies = lies
        return TensorDict({"agents": TensorDict(values, shape)}, self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones(self.batch_size, dtype=torch.bool) if mask is None else mask.view(-1)
        self._begin(mask)
        self.episode = self.episode + mask
        return self._show().set("done", torch.zeros(*self.batch_size, 1, dtype=torch.bool))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.total += 1
        action = tensordict["agents", "action"]
        if action.is_floating_point():
            action = (action * action.new_tensor([1.0, 10.0])).round().sum(-1)
        self.x = (3 * self.x + action.long() + 1) % 101
        self.executed = action
        self.action_valid = tensordict.get(("agents", "action_valid"), self.action_valid)
        shown = self._show()
        reward = (self.x + 100 * self.names.unsqueeze(-1) - 1000 * self.lies).float()
        shown["agents"].set("reward", reward.unsqueeze(-1))
        over = counter_rng.uniform(self.names, torch.tensor(self.total)) < self.ends
        return shown.set("done", over.unsqueeze(-1)).set("terminated", over.unsqueeze(-1))

    def _set_seed(self, seed: int | None) -> None:
        """Nothing here is random."""
