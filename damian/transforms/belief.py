"""A transform that computes, from the messages that have arrived, where the source is believed to be."""

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite

from damian import keys
from damian.server.belief import Beliefs, SourceGrid, Window, advance, begin, empty_window, report_rows
from damian.server.server import Server
from damian.transforms.base import StatefulTransform
from damian.transforms.entries import Change, Entries, Memory, as_rows, from_rows
from damian.transforms.order import KeyUsage


class Belief(StatefulTransform):
    """Writes the probability that the source is in each cell of a grid, by Bayes' rule.

    The belief of the server is exact for the messages that have arrived by now, whenever they were sent, and
    it knows no others. For each world the memory holds the beliefs of the latest steps, as they follow from
    what is known now, and the messages sent in them; when a message comes in late, the filter runs again from
    the step in which it was sent. ``damian.make_env`` adds the transform if a feature reads the belief.

    It writes ``belief`` [B, K] and, if ``own``, ``("agents", "belief")`` [B, N, K]: that of each UAV, which
    knows its own messages at once.

    Args:
        server: server node, whose grid the belief is about.
        longest: longest delay of a message [steps].
        delayed: whether the delays of the messages are in ``("agents", "delay")``; if not, none is delayed.
        own: compute the belief of each UAV too.

    Examples:
        >>> env = UavEnv(scenario, num_worlds=64, extras=["message"], messages_only=True)
        >>> uplink = ObservationDelay(3, keys.MESSAGE, keys.RECEIVED, delay_key=keys.DELAY)
        >>> believe = Belief(env.server, longest=3, delayed=True)
        >>> env = TransformedEnv(env, Compose(uplink, believe, ServerNode(env.server)))
    """

    per_world = True

    def __init__(self, server: Server, longest: int, *, delayed: bool, own: bool = False) -> None:
        reads: list[NestedKey] = [keys.MESSAGE, keys.MESSAGE_SENT, *([keys.DELAY] if delayed else [])]
        super().__init__(reads, [keys.BELIEF, *([keys.OWN_BELIEF] if own else [])])
        self.server, self.longest, self.delayed, self.own = server, longest, delayed, own
        self.step_keys = reads

    @property
    def key_usage(self) -> KeyUsage:
        return KeyUsage(reads=self.in_keys, creates=self.out_keys)

    @property
    def memory_sizes(self) -> dict[str, int]:
        return {"longest": self.longest, "own": int(self.own)}

    @property
    def row_dims(self) -> dict[str, int]:
        return dict.fromkeys(("belief", "same_as_server", "report", "delay"), 2)

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        n_worlds, n_agents = self.rows.numel(), tensordict.get(keys.MESSAGE).shape[-2]
        return empty_window(self._grid, self.longest, n_worlds, n_agents, self.own)._asdict()

    def memory_bytes(self, tensordict: TensorDictBase, n_rows: int) -> int:
        n_agents, n_cells = tensordict.get(keys.MESSAGE).shape[-2], self._grid.prior.shape[-1]
        viewers = 1 + n_agents * self.own
        return n_rows * (self.longest + 2) * (viewers * (4 * n_cells + 1) + n_agents * 16)

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        messages = self.server.messages(as_rows(entries[keys.MESSAGE], self.rows))
        region = self.server.region_of(messages)
        return memory, self._written(begin(self._grid, Window(**memory), messages, region, mask))

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        rows = {key: as_rows(entries[key], self.rows) for key in self.in_keys}
        messages = self.server.messages(rows[keys.MESSAGE])
        report = report_rows(self._grid, messages, rows[keys.MESSAGE_SENT])
        delay = rows[keys.DELAY].squeeze(-1) if self.delayed else torch.zeros_like(report)
        region = self.server.region_of(messages)
        every = torch.ones_like(region, dtype=torch.bool)
        stepped = entries[keys.STEPPED].reshape(-1) if keys.STEPPED in entries else every
        window, beliefs = advance(self._grid, Window(**memory), report, delay, region, stepped)
        return window._asdict(), self._written(beliefs)

    def note_late(self, memory: Memory, message: Tensor, agent: int, lag: int) -> Memory:
        """Note a message whose delay nobody knew when it was sent, before the step in which it arrives.

        Args:
            memory: of a single world, before the step; it is changed in place.
            message: the packed message, [M].
            agent: number of its UAV.
            lag: the delay, steps from when it was sent to the step that follows; at least 1. One above
                ``longest`` changes nothing.
        """
        if lag <= self.longest:
            messages = self.server.messages(message.view(1, 1, -1))
            slot = (memory["slot"] + 1 - lag) % len(memory["report"])
            every = torch.ones_like(messages.spotted)
            memory["report"][slot, agent] = report_rows(self._grid, messages, every).view(-1)
            memory["delay"][slot, agent] = lag
        return memory

    def _written(self, beliefs: Beliefs) -> Entries:
        """The entries to write."""
        own: Entries = {keys.OWN_BELIEF: from_rows(beliefs.own, self.rows)} if self.own else {}
        return {keys.BELIEF: from_rows(beliefs.server, self.rows), **own}

    @property
    def _grid(self) -> SourceGrid:
        if self.server.grid is None:
            raise RuntimeError("the server has no grid, because no feature reads the belief")
        return self.server.grid

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        worlds, n_agents = observation_spec[keys.MESSAGE].shape[:-2], observation_spec[keys.MESSAGE].shape[-2]
        n_cells = self._grid.prior.shape[-1]
        for key, shape in ((keys.BELIEF, worlds), (keys.OWN_BELIEF, (*worlds, n_agents))):
            if key in self.out_keys:
                size = torch.Size((*shape, n_cells))
                observation_spec[key] = Bounded(0.0, 1.0, size, device=observation_spec.device)
        return observation_spec
