"""The context of delayed messages, for delay laws that see who sends, from where, when, and how
many do."""

from collections.abc import Mapping
from typing import cast

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor

from damian.common import checks, counter_rng
from damian.delays.samplers import Context, MessageContext, Sampler
from damian.transforms.base import Memory
from damian.transforms.entries import Entries, as_rows, sibling_key


class ContextReader:
    """Builds the context of the messages that a transform delays; does nothing if their law sees
    none.

    The transform's memory must hold ``streams``, ``state``, ``clock`` and ``reset_at``, as in
    ``DelayLine``. ``context_keys`` are those of the entries that the law gets, by name; a bare name
    means an
    entry beside ``beside``. ``before_step``: the messages are sent before the environment steps, as
    actions are.
    """

    def __init__(
        self,
        sampler: Sampler,
        context_keys: Mapping[str, NestedKey] | None,
        dt: float,
        beside: NestedKey,
        before_step: bool = False,
    ) -> None:
        self._sees_context = sampler.sees_context
        self._dt = dt
        self._since_clock = 0 if before_step else 1
        known = dict(context_keys or {}) if sampler.sees_context else {}
        for name in sampler.reads:
            checks.require(
                name in known,
                "context_keys",
                known,
                f"has no key for {name}, which the delay law reads",
            )
        nested = {name: sibling_key(beside, unravel_key(key)) for name, key in known.items()}
        self.keys = cast(dict[str, NestedKey], nested)
        """Keys of the entries that the law gets, by name."""

    def init_memory(self, memory: Memory, tensordict: TensorDictBase, rows: torch.Size) -> Memory:
        """Add what the contexts need to the memory of the transform, M rows of the shape
        ``rows``."""
        if not self._sees_context:
            return memory
        n_agents = rows.numel() // tensordict.batch_size.numel()
        return memory | {"agents": torch.arange(n_agents, device=memory["streams"].device)}

    def read(
        self, memory: Memory, entries: Entries, sent: Tensor | None, rows: torch.Size
    ) -> Context:
        """The context of the messages ``sent`` [M] (None: all) in this step; None if the law sees
        none."""
        if not self._sees_context:
            return None
        agents = memory["agents"]
        streams = memory["streams"]
        n_sending = torch.full_like(streams, len(agents))
        if sent is not None:
            by_world = sent.view(-1, len(agents))
            n_sending = by_world.sum(-1, keepdim=True).expand_as(by_world).reshape(-1)
        sender = agents.repeat(len(streams) // len(agents))
        receiver = torch.full_like(streams, -1)
        time = (memory["clock"] + self._since_clock - memory["reset_at"]) * self._dt
        uniform = counter_rng.uniform(streams, memory["clock"] + 1)
        read = {name: as_rows(entries[key], rows) for name, key in self.keys.items()}
        return MessageContext(sender, receiver, n_sending, time, uniform, self._dt, read)
