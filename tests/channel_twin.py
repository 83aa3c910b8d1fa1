"""Reference implementation of ``Channel`` in plain Python, for one world and one link at a time."""

from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import torch
from delay_twin import drawn
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp

from damian.common import counter_rng
from damian.delays.laws import law_of, sampler_of

Link = tuple[int, int]
"""Receiver and sender."""


class Packet(NamedTuple):
    """What is in transit to somebody."""

    arrives: int
    sent: int
    to: Any
    content: Any


class World:
    """Agents that send to each other.

    Args:
        n_agents: number of agents, N.
        delay: delay of what is sent on a link at a clock [steps], None if it is lost.
        limit: number of agents that may send in a step.
        turn: who may send first at a clock: the agent with the smallest number.
        known: does everyone know everyone's first message.
        own_at_reset: is there an own message at the reset.
    """

    def __init__(
        self,
        n_agents: int,
        delay: Callable[[int, Link, int], int | None],
        limit: int | None = None,
        turn: Callable[[int, int], tuple] | None = None,
        known: bool = False,
        own_at_reset: bool = True,
    ) -> None:
        self.agents, self.delay, self.limit = range(n_agents), delay, limit
        self.turn, self.known, self.own_at_reset = turn, known, own_at_reset
        self.clock, self.began = 0, 0

    def senders(self, wanted: Collection[Link]) -> list[int]:
        """The agents that may send."""
        waiting = {sender for _, sender in wanted}
        if self.limit is None:
            return sorted(waiting)
        return sorted(waiting, key=lambda sender: self.turn(self.clock, sender))[: self.limit]

    def step(self, contents: Sequence[Any], wanted: Collection[Link], begins: bool = False) -> None:
        """Send on the wanted links, and receive."""
        self.clock += 1
        if begins:
            self.began, self.in_transit, self.holds = self.clock, [], {}
        senders = self.senders(wanted)
        for link in wanted:
            delay = self.delay(self.clock, link, len(senders)) if link[1] in senders else None
            if delay is not None:
                self.in_transit.append(Packet(self.clock + delay, self.clock, link, contents[link[1]]))
        for packet in self.in_transit:
            if packet.arrives == self.clock and (
                packet.to not in self.holds or self.holds[packet.to][0] < packet.sent
            ):
                self.holds[packet.to] = (packet.sent, packet.content)
        if begins and self.known:
            self.holds = {(i, j): (self.clock, contents[j]) for i in self.agents for j in self.agents}
        self.own = contents

    def seen(self, receiver: int, sender: int, zeros: Any) -> tuple[Any, int, bool]:
        """Content and age of what a receiver holds of a sender, and whether it holds anything."""
        since = self.clock - self.began
        if receiver == sender:
            return (self.own[sender], 0, True) if since or self.own_at_reset else (zeros, 0, False)
        if (receiver, sender) not in self.holds:
            return zeros, since, False
        sent, content = self.holds[receiver, sender]
        return content, self.clock - sent, True


def table(law: Any, streams: Tensor, n_steps: int, loss: float = 0.0) -> Callable[[int, int], int | None]:
    """The delay that a law draws at a clock for a row; None if the message is lost."""
    sampler = sampler_of(law_of(law), loss=loss)
    delays = drawn(sampler, streams, n_steps).tolist()
    return lambda clock, row: None if (d := delays[clock - 1][row]) == sampler.lost else d


def turn(stream: Tensor, clock: int, sender: int) -> tuple[int, int]:
    """Whoever has the smallest turn may send first."""
    counters = (torch.tensor(counter) for counter in (clock, 4, sender))
    return int(counter_rng.bits(stream, *counters)), sender


Wants = Callable[[TensorDictBase, TensorDictBase | None, int], Collection[Link]]
"""The links on which a world wants to send, from the outputs, from the inputs (None at a reset)."""


def check_against_twin(
    env: TransformedEnv,
    make: Callable[[int, Tensor], World],
    wants: Wants,
    n_steps: int = 25,
    forced: Callable[[int], list[int]] = lambda _: [],
    sent: Any = ("agents", "observation"),
) -> list[TensorDictBase]:
    """Compare every output of a rollout with partial resets with that of the twins.

    Args:
        env: environment with one ``Channel``.
        make: the twin of a world, given its number and the channel's random streams.
        wants: which links carry a message.
        n_steps: number of steps.
        forced: worlds to reset after a step, beside those that are done.
        sent: key of what is sent, among the outputs, or among the inputs of a step.
    """
    torch.manual_seed(0)
    td, worlds = env.reset(), range(env.batch_size[0])
    channel = env.transform[-1] if len(env.transform) else env.transform
    memory = channel.memory
    twins = [make(b, memory["streams"]) for b in worlds]

    def follow(outputs: TensorDictBase, inputs: TensorDictBase | None, mask: list[bool]) -> None:
        source = outputs if sent in outputs.keys(True) else inputs
        for b in worlds:
            if mask[b]:
                no_content = [[0.0]] * len(twins[b].agents)
                contents = source[sent][b].tolist() if source is not None else no_content
                twins[b].step(contents, wants(outputs, inputs, b), begins=inputs is None)
            assert_same(twins[b], outputs[b])

    follow(td, None, [True] * len(worlds))
    seen = [td]
    for t in range(n_steps):
        td = env.rand_action(td)
        stepped = env.step(td)
        follow(stepped["next"], stepped, [True] * len(worlds))
        td = step_mdp(stepped)
        mask = td["done"].view(-1).tolist()
        mask = [done or b in forced(t) for b, done in enumerate(mask)]
        if any(mask):
            td = env.reset(td.set("_reset", torch.tensor(mask).unsqueeze(-1)))
            follow(td, None, mask)
        seen += [stepped["next"], td]
    return seen


def assert_same(twin: World, outputs: TensorDictBase) -> None:
    """The messages that each agent has received from each other one are those of the twin."""
    got = [outputs["agents", name].tolist() for name in ("received", *FLAGS)]
    zeros = [0.0] * len(got[0][0][0])
    for i in twin.agents:
        for j in twin.agents:
            assert tuple(part[i][j] for part in got) == tuple(twin.seen(i, j, zeros)), (i, j)


FLAGS = ("received_age", "received_mask")
