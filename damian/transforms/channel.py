"""A transform through which agents send messages to each other, which arrive late or are lost."""

from collections.abc import Sequence
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded

from damian.common import checks
from damian.common.errors import naming_errors
from damian.common.text_files import listed, show
from damian.delays.laws import same_size
from damian.keys import STEPPED
from damian.transforms.base import StatefulTransform
from damian.transforms.entries import (
    Change,
    Entries,
    Memory,
    as_rows,
    read_keys,
    require_as_many,
    require_keys,
    require_new,
    row_bytes,
    row_shape,
    select_entries,
    sibling_key,
    spec_rows,
)
from damian.transforms.order import KeyUsage
from damian.transforms.topology import DirectLinks, Rules, Sending, make_topology


class Channel(StatefulTransform):
    """Lets the agents of a group send messages to each other, which arrive some steps later or are lost.

    In each step an agent sends entries of its own (``in_keys``), or what its policy chooses (``action_key``).
    Each receiver holds, of each sender, the message that was generated last of those that have arrived, and
    observes it, its age, and whether any has arrived in this episode. An agent knows its own message at once.
    The outputs of a reset are sent like those of a step; a chosen message exists from the first step on, in
    whose outputs it arrives with delay 0. With delay 0 everyone sees everyone's current message. No gradient
    flows through the channel.

    What an agent sends is stored once for all receivers. With a longest delay of K steps, N agents and
    contents of F float32 numbers, a world takes 4 (K + 1) N F bytes for what is in transit, 4 N^2 F for what
    is held, and about 8 (K + 10) N^2 for times and states of the links: 31 kB with K = 10, N = 10, F = 18. It
    would take 109 kB if each link stored what is in transit on it.

    Args:
        delay: steps (``3``), a time (``"3s"``), or a law of ``damian.delays.laws`` (``Uniform(3, 7)``); or an
            N x N nested list of them, ``delay[receiver][sender]``, whose diagonal is not used. A delay is
            drawn for each receiver and message. With a ``position_key``, a law may read ``position`` and
            ``receiver_position``; with a server, ``position`` is that of the agent that sends or receives.
        in_keys: keys of the entries [*B, N, ...] of a group of agents that every agent sends together; if
            neither this nor ``action_key`` is given, ``("agents", "observation")``.
        out_keys: keys under which the received entries are written, [*B, N, N, ...] (receiver, sender); if
            not given, ``received``, and with several in_keys ``received_`` and the name of each.
        loss: probability that a message does not reach a receiver, or an N x N nested list of it.
        topology: ``all``: agents send to all others. ``server``: agents send to a server by ``delay`` and
            ``loss``; in each step the server broadcasts the newest message that it holds of each agent, and
            each receiver gets this broadcast by ``down_delay`` and ``down_loss``. A nested list or tensor
            [N, N] of bool: which sender each receiver hears.
        down_delay: delay from the server to an agent; 0 if not given.
        down_loss: probability that a broadcast of the server does not reach an agent.
        comm_range: an agent hears only agents within this distance [m] when they send.
        position_key: key of an entry [*B, N, ...] whose first two numbers are the agent's position [m].
        limit: so many agents of a world may send in a step, as on a shared medium; a random draw decides
            among those that want to. A server's broadcasts do not count.
        sent_key: key of a flag [*B, N] bool: does the agent send in this step.
        request_key: key of a flag, [*B, N, N] (receiver, sender) or [*B, N] (receiver, for all senders) bool:
            only what is asked for is sent.
        action_key: key of an action [*B, N, message_size] in [-1, 1] that the transform adds to the action
            spec, and sends.
        message_size: how many numbers ``action_key`` has.
        known_at_reset: everyone knows everyone's first message, whatever the delay and the topology.
        dt: length of a step [s], for delays given as times.
        age_key: key for the age of the held messages, in steps, [*B, N, N] float; before one has arrived,
            steps since the reset; None to leave it out.
        mask_key: key for a flag, [*B, N, N] bool: has a message of this episode arrived; None to leave it
            out.
        seed: seed of all draws until the environment is seeded; if there is none, it is drawn from torch's
            global generator at the first reset.

    A bare name for one of the keys means an entry in the same TensorDict as ``in_keys[0]`` or ``action_key``.
    The flags ``sent_key`` and ``request_key`` are read from the outputs of a reset and of each step. If a
    reset has no such entry, the policy must write it before each step, and nothing is sent at the reset.

    Raises:
        InputError: an argument is invalid, or does not go with another one.

    Examples:
        >>> env = VmasEnv("navigation", num_envs=32, n_agents=3)
        >>> env = TransformedEnv(env, Channel(Uniform(1, 5), loss=0.1))
        >>> env.rollout(100)["agents", "received"]  # [32, 100, 3, 3, 18]
    """

    optional_keys = ("age_key", "mask_key")

    def __init__(
        self,
        delay: Any,
        in_keys: NestedKey | Sequence[NestedKey] | None = None,
        out_keys: NestedKey | Sequence[NestedKey] | None = None,
        *,
        loss: Any = 0.0,
        topology: Any = "all",
        down_delay: Any = None,
        down_loss: float | None = None,
        comm_range: float | None = None,
        position_key: NestedKey | None = None,
        limit: int | None = None,
        sent_key: NestedKey | None = None,
        request_key: NestedKey | None = None,
        action_key: NestedKey | None = None,
        message_size: int | None = None,
        known_at_reset: bool = False,
        dt: float = 1.0,
        age_key: NestedKey | None = "received_age",
        mask_key: NestedKey | None = "received_mask",
        seed: int | None = None,
    ) -> None:
        _check_action(action_key, message_size, in_keys, known_at_reset)
        sent, written, beside = _keys_of(in_keys, out_keys, action_key)
        super().__init__(sent, written, seed=seed)
        self.action_key = None if action_key is None else beside
        self.message_size, self._beside = message_size, beside
        self.age_key, self.mask_key, self.sent_key, self.request_key, self.position_key = (
            sibling_key(beside, key) for key in (age_key, mask_key, sent_key, request_key, position_key)
        )
        if limit is not None:
            checks.whole("limit", limit, 1, unit="agents")
        self.n_agents = same_size({"delay": delay, "loss": loss, "topology": topology})
        """The number of agents for which links are given one by one, if any are."""
        rules = Rules(dt, limit, known_at_reset, sends_at_reset=action_key is None)
        self.topology = make_topology(
            topology, delay, loss, down_delay, down_loss, comm_range, rules, position_key is not None
        )
        should = "does not go with topology='server': requests go to agents"
        to_agents = isinstance(self.topology, DirectLinks)
        checks.require(request_key is None or to_agents, "request_key", request_key, should)
        self.draws = self.topology.draws
        self.memory_setting = "Channel: delay", show(delay)
        self.flag_keys = [key for key in (self.sent_key, self.request_key) if key is not None]
        self.action_keys = [*([self.action_key] if self.action_key else []), *self.flag_keys]
        self.step_keys = [*self.required_keys, *self.flag_keys]

    @property
    def memory_sizes(self) -> dict[str, int]:
        return {"longest": self.topology.longest, "in_keys": len(self.in_keys)}

    @property
    def row_key(self) -> NestedKey:
        return self._beside

    @property
    def key_usage(self) -> KeyUsage:
        return KeyUsage(reads=self.step_keys, creates=self._written)

    @property
    def required_keys(self) -> Sequence[NestedKey]:
        return [*self.in_keys, *([self.position_key] if self.position_key else [])]

    @property
    def _written(self) -> list[NestedKey]:
        return [*self.out_keys, *(key for key in (self.age_key, self.mask_key) if key is not None)]

    def find_rows(self, tensordict: TensorDictBase) -> torch.Size:
        agents = row_shape(tensordict, self.row_key)
        self._check_agents(agents, len(tensordict.batch_size))
        return self.topology.rows(agents)

    def _check_agents(self, agents: torch.Size, n_batch: int) -> None:
        """Require that the entries are those of a group of agents, [*B, N]."""
        name = "action_key" if self.action_key else "in_keys"
        checks.require(len(agents) == n_batch + 1, name, self._beside, _NO_GROUP)
        n, given = agents[-1], self.n_agents
        should = f"are given for {given} agents, but {self._beside} is of {n}"
        checks.require(given in (None, n), "Channel", "the links", should)

    @property
    def agents(self) -> torch.Size:
        """The shape of the agents, [*B, N]."""
        return self.rows[:-1] if isinstance(self.topology, DirectLinks) else self.rows

    # The memory is that of the topology; ``flag_i`` [M] holds what the policy wrote under ``flag_keys[i]``.

    def memory_bytes(self, tensordict: TensorDictBase, n_rows: int) -> int:
        agents = row_shape(tensordict, self.row_key)
        size = row_bytes(select_entries(tensordict, self.in_keys), agents.numel())
        return self.topology.n_bytes(agents.numel(), agents[-1], size + 4 * (self.message_size or 0))

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        entries = select_entries(tensordict, self.step_keys)
        contents = self._contents(entries, next(iter(tensordict.values(True, True))).device)
        streams = self.streams(tensordict.batch_size, contents[0].device)
        memory = self.topology.init_memory(contents, streams, self.agents[-1])
        with naming_errors("Channel: its delay"):
            self.topology.try_laws(memory, self._position(entries))
        absent = [i for i, key in enumerate(self.flag_keys) if key not in entries]
        return memory | {f"flag_{i}": torch.zeros_like(streams, dtype=torch.bool) for i in absent}

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        self.topology.write(memory, self._contents(entries, mask.device))
        silent = {name: torch.zeros_like(memory[name]) for name in memory if name.startswith("flag_")}
        wanted = mask & self._wanted(memory | silent, entries, mask)
        sending = Sending(mask, wanted & (self.action_key is None), self._position(entries))
        memory = memory | self.topology.reset(memory, sending)
        return memory, self._outputs(memory)

    def on_action(self, memory: Memory, entries: Entries) -> Change:
        if self.action_key:
            self.topology.write(memory, [as_rows(entries[self.action_key], self.agents)])
        written = {}
        for i, key in enumerate(self.flag_keys):
            if f"flag_{i}" in memory:
                should = "is neither an output of the environment nor written by the policy before a step"
                checks.require(key in entries, "Channel", key, should)
                written[f"flag_{i}"] = self._flag_rows(key, entries[key])
        return memory | written, {}

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        if not self.action_key:
            self.topology.write(memory, [as_rows(entries[key], self.agents) for key in self.in_keys])
        device = next(iter(memory.values())).device
        active = torch.ones(self.rows.numel(), dtype=torch.bool, device=device)
        if STEPPED in entries:
            active = self.expand_worlds(entries[STEPPED].reshape(-1))
        sending = Sending(active, self._wanted(memory, entries, active), self._position(entries))
        memory = memory | self.topology.step(memory, sending)
        return memory, self._outputs(memory)

    def _contents(self, entries: Entries, device: torch.device) -> list[Tensor]:
        """What the agents send at a reset, [B * N, ...] each; zeros for an action that is not chosen yet."""
        if self.message_size:
            return [torch.zeros(self.agents.numel(), self.message_size, device=device)]
        return [as_rows(entries[key], self.agents) for key in self.in_keys]

    def _position(self, entries: Entries) -> Tensor | None:
        """Positions of the agents [m], [B * N, 2]."""
        return as_rows(entries[self.position_key], self.agents)[:, :2] if self.position_key else None

    def _wanted(self, memory: Memory, entries: Entries, active: Tensor) -> Tensor:
        """Rows among the active ones [M] on which an agent wants to send, [M] bool."""
        for i, key in enumerate(self.flag_keys):
            written = memory.get(f"flag_{i}")
            active = active & (self._flag_rows(key, entries[key]) if written is None else written)
        return active

    def _flag_rows(self, key: NestedKey, flag: Tensor) -> Tensor:
        """A flag of agents, or of receivers and senders, as rows, [M] bool."""
        n, total, asks = self.agents[-1], self.agents.numel(), key == self.request_key
        sizes = [total, total * n] if asks else [total]
        should = (
            f"has {flag.numel()} values of {flag.dtype}, but there are agents of shape {tuple(self.agents)}"
        )
        good = flag.dtype == torch.bool and flag.numel() in sizes
        checks.require(good, "request_key" if asks else "sent_key", key, should)
        if flag.numel() == self.rows.numel():
            return flag.reshape(-1)
        by_link = flag.reshape(-1, n, 1) if asks else flag.reshape(-1, 1, n)
        return by_link.expand(-1, n, n).reshape(-1)

    def _outputs(self, memory: Memory) -> Entries:
        received, shape = self.topology.received(memory), (*self.agents, self.agents[-1])
        flags = {self.age_key: received.age.to(torch.float32), self.mask_key: received.arrived}
        values = [*received.contents, *(value for key, value in flags.items() if key is not None)]
        return {
            key: value.view(*shape, *value.shape[2:])
            for key, value in zip(self._written, values, strict=True)
        }

    # The chosen message is an action for the policy, but none for the environment.

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = super()._inv_call(tensordict)
        return tensordict.exclude(self.action_key) if self.action_key else tensordict

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        input_spec = super().transform_input_spec(input_spec)
        if self.action_key and self.message_size:
            specs = cast(Composite, input_spec)["full_action_spec"]
            known = list(specs.keys(True, True))
            should = f"is not a new name beside one of the actions {listed(map(str, known))}"
            beside = [sibling_key(key, self.action_key[-1]) for key in known]
            good = self.action_key in beside and self.action_key not in known
            checks.require(good, "action_key", self.action_key, should)
            shape = torch.Size((*spec_rows(specs, self.action_key), self.message_size))
            specs[self.action_key] = Bounded(-1.0, 1.0, shape, device=specs.device)
        return input_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        require_keys("Channel", self.required_keys, observation_spec)
        agents, device = spec_rows(observation_spec, self._beside), observation_spec.device
        self._check_agents(agents, len(observation_spec.shape))
        if self.action_key:
            require_new("Channel", self.action_key, observation_spec.keys(True))
        sent = [observation_spec[key] for key in self.in_keys]
        kinds = [(spec.shape[len(agents) :], spec.dtype) for spec in sent]
        kinds += [((self.message_size,), torch.float32)] if self.message_size else []
        kinds += [((), torch.float32)] if self.age_key else []
        kinds += [((), torch.bool)] if self.mask_key else []
        for key, (size, dtype) in zip(self._written, kinds, strict=True):
            shape = torch.Size((*agents, agents[-1], *size))
            numbers = Unbounded(shape, dtype=dtype, device=device)
            flags = Binary(shape[-1], shape, dtype=dtype, device=device)
            observation_spec[key] = flags if dtype == torch.bool else numbers
        return observation_spec


def _check_action(action_key: Any, message_size: Any, in_keys: Any, known_at_reset: bool) -> None:
    """Require that what is sent is clear."""
    if action_key is None:
        checks.require(message_size is None, "message_size", message_size, "needs an action_key")
        return
    checks.whole("message_size", message_size, 1, unit="numbers")
    should = "does not go with in_keys: agents send these or an action; use two Channels for both"
    checks.require(in_keys is None, "action_key", action_key, should)
    should = "does not go with action_key: at a reset no message has been chosen yet"
    checks.require(not known_at_reset, "known_at_reset", known_at_reset, should)


def _keys_of(
    in_keys: Any, out_keys: Any, action_key: Any
) -> tuple[list[NestedKey], list[NestedKey], NestedKey]:
    """Keys of the entries that are sent and received, and the key beside which a bare name is meant."""
    sent = read_keys(("agents", "observation") if in_keys is None else in_keys) if action_key is None else []
    checks.require(bool(sent or action_key), "in_keys", in_keys, "name nothing to send")
    beside = sent[0] if sent else unravel_key(action_key)
    checks.require(isinstance(beside, tuple), "action_key" if not sent else "in_keys", beside, _NO_GROUP)
    names = [f"received_{key[-1]}" for key in sent] if len(sent) > 1 else ["received"]
    written = [sibling_key(beside, key) for key in (names if out_keys is None else read_keys(out_keys))]
    written = cast(list[NestedKey], written)
    require_as_many(names, written)
    return sent, written, beside


_NO_GROUP = "is not in a group of agents, as ('agents', 'observation') is"
