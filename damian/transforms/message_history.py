"""A transform that keeps the messages of the latest steps, as far as they have arrived."""

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded

from damian.common import checks
from damian.common.tensors import expand_mask
from damian.transforms.base import StatefulTransform
from damian.transforms.entries import (
    Change,
    Entries,
    Memory,
    as_rows,
    require_keys,
    sibling_key,
    spec_rows,
)
from damian.transforms.order import KeyUsage

_NEVER = 2**31
"""Steps until the arrival of a message that never arrives."""


class MessageHistory(StatefulTransform):
    """Writes the messages of the latest steps that have arrived, those that came late or out of order too.

    ``ObservationDelay`` lets a receiver hold one message, the newest; this transform keeps all that were sent
    in the latest ``steps`` steps of the episode. It comes after ``ObservationDelay(..., delay_key=...)``,
    which draws the delays. A row of the history has D + 3 numbers: those of the message, which are 0 before
    it arrives; whether it has arrived; its age over ``steps``; and whether it is the receiver's own. The
    newest message comes first. The message of a reset arrives at once.

    With ``group`` every agent gets the messages of all agents of its world: its own first, then those of the
    agents after it.

    Args:
        steps: number of latest steps, K.
        message_key: key of the message of a step, [..., D].
        out_key: key of the history, [..., L, D + 3], float32, or float64 as the messages; L is K, or N K with
            ``group``. A bare name, here and below, means an entry beside the message.
        delay_key: key of the delay of the message sent in this step [steps], [..., 1], -1 if it never
            arrives; None if messages are not delayed.
        sent_key: key of a flag, [...] bool: which rows send a message in this step; if not given, all do.
        encode: function from messages [..., M] to the D numbers to keep; if not given, these are the message.
        group: whether agents get the messages of all agents of their world.
        own: whether an agent knows its own messages as soon as they are sent.

    Raises:
        InputError: the number of steps is not a positive integer, or ``group`` has no agents.

    Examples:
        >>> delay = ObservationDelay(Uniform(3, 7), "observation", "received", delay_key="delay")
        >>> history = MessageHistory(8, "observation", delay_key="delay")
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(delay, history))
        >>> env.rollout(100)["history"]  # [100 steps, 8 messages, 3 + 3 numbers]
    """

    def __init__(
        self,
        steps: int,
        message_key: NestedKey = "observation",
        out_key: NestedKey = "history",
        *,
        delay_key: NestedKey | None = None,
        sent_key: NestedKey | None = None,
        encode: Callable[[Tensor], Tensor] | None = None,
        group: bool = False,
        own: bool = False,
    ) -> None:
        checks.whole("steps", steps, 1)
        super().__init__(message_key)
        self.steps, self.encode, self.group, self.own = steps, encode, group, own
        written, self.delay_key, self.sent_key = (
            sibling_key(self.row_key, key) for key in (out_key, delay_key, sent_key)
        )
        self.out_keys = [written]
        self.step_keys = [self.row_key, *(key for key in (self.delay_key, self.sent_key) if key is not None)]
        self.memory_setting = "MessageHistory: steps", steps

    @property
    def key_usage(self) -> KeyUsage:
        return KeyUsage(reads=self.step_keys, creates=self.out_keys)

    @property
    def memory_sizes(self) -> dict[str, int]:
        return {"steps": self.steps}

    @property
    def required_keys(self) -> Sequence[NestedKey]:
        return self.step_keys

    def memory_bytes(self, tensordict: TensorDictBase, n_rows: int) -> int:
        encoded = self._encoded(tensordict.get(self.row_key))
        n_columns, kept, written = encoded.shape[-1], encoded.dtype.itemsize, _dtype(encoded).itemsize
        receivers = tensordict.get(self.row_key).shape[-2] if self.group else 1
        return n_rows * self.steps * (8 + kept * n_columns + written * receivers * (n_columns + 3))

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        message = as_rows(self._encoded(tensordict.get(self.row_key)), self.rows)
        kept = message.new_zeros(len(message), self.steps, message.shape[-1])
        due = torch.full(kept.shape[:2], _NEVER, dtype=torch.long, device=message.device)
        return {"kept": kept, "due": due, "sent": torch.zeros_like(due, dtype=torch.bool)}

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        empty = {
            "kept": torch.zeros_like(memory["kept"]),
            "due": torch.full_like(memory["due"], _NEVER),
            "sent": torch.zeros_like(memory["sent"]),
        }
        at_once = torch.zeros_like(mask, dtype=torch.long)
        begun = self._added(empty, entries[self.row_key], at_once, torch.ones_like(mask))
        memory = {name: torch.where(expand_mask(mask, new), new, memory[name]) for name, new in begun.items()}
        return memory, self._written(memory)

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        due = torch.zeros_like(memory["due"][:, 0])
        if self.delay_key is not None:
            delay = entries[self.delay_key].reshape(-1)
            due = torch.where(delay >= 0, delay, _NEVER)
        sent = torch.ones_like(due, dtype=torch.bool)
        if self.sent_key is not None:
            sent = entries[self.sent_key].reshape(-1)
        memory = self._added(memory, entries[self.row_key], due, sent)
        return memory, self._written(memory)

    def note_late(self, memory: Memory, message: Tensor, agent: int, lag: int) -> Memory:
        """Note a message whose delay nobody knew when it was sent, before the step in which it arrives.

        Args:
            memory: of a single world, before the step.
            message: the packed message, [...].
            agent: number of its sender, the row of the memory.
            lag: the delay, steps from when it was sent to the step that follows; at least 1. One above
                ``steps`` changes nothing.
        """
        if lag > self.steps:
            return memory
        row = {"kept": self._encoded(message.view(1, 1, -1)).view(-1), "due": 1, "sent": True}
        memory = memory | {name: memory[name].clone() for name in row}
        for name, value in row.items():
            memory[name][agent, lag - 1] = value
        return memory

    def _added(self, memory: Memory, message: Tensor, due: Tensor, sent: Tensor) -> Memory:
        """The memory with the messages of a step as the newest ones.

        Args:
            memory: before the step.
            message: the messages, [*rows, ...].
            due: steps until they arrive, [M].
            sent: which of them are really sent, [M] bool.
        """
        newest = {
            "kept": as_rows(self._encoded(message), self.rows),
            "due": torch.where(sent, due, _NEVER),
            "sent": sent,
        }
        older = {"kept": memory["kept"], "due": memory["due"] - 1, "sent": memory["sent"]}
        return {name: torch.cat([new.unsqueeze(1), older[name][:, :-1]], 1) for name, new in newest.items()}

    def _written(self, memory: Memory) -> Entries:
        """The history, from the memory."""
        arrived = memory["due"] <= 0
        age = torch.arange(self.steps, device=arrived.device) / self.steps
        n_agents = self.rows[-1] if self.group else 1
        agent = torch.arange(n_agents, device=arrived.device)
        sender = (agent.unsqueeze(-1) + agent) % n_agents  # [N receivers, N senders], its own first
        own = (agent == 0).unsqueeze(-1)  # of the senders, [N, 1]

        def for_receivers(rows: Tensor) -> Tensor:
            return rows.unflatten(0, (-1, n_agents))[:, sender]  # [worlds, N, N, K, ...]

        known = for_receivers(arrived)
        if self.own:
            known = known | (own & for_receivers(memory["sent"]))
        flags = (flag.expand(known.shape).unsqueeze(-1).float() for flag in (known, age, own))
        kept = for_receivers(memory["kept"]) * known.unsqueeze(-1)
        rows = torch.cat([kept, *flags], -1)  # [worlds, N receivers, N senders, K, D + 3]
        return {self.out_keys[0]: rows.reshape(*self.rows, -1, rows.shape[-1])}

    def _encoded(self, message: Tensor) -> Tensor:
        return message if self.encode is None else self.encode(message)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        require_keys(type(self).__name__, [self.row_key], observation_spec)
        spec, rows = observation_spec[self.row_key], spec_rows(observation_spec, self.row_key)
        should = "needs messages of several agents, under a nested key such as ('agents', 'message')"
        checks.require(not self.group or len(rows) > len(observation_spec.shape), "group", True, should)
        encoded = self._encoded(spec.zero())
        shape = (*rows, self.steps * (rows[-1] if self.group else 1), encoded.shape[-1] + 3)
        observation_spec[self.out_keys[0]] = Unbounded(
            torch.Size(shape), dtype=_dtype(encoded), device=observation_spec.device
        )
        return observation_spec


def _dtype(encoded: Tensor) -> torch.dtype:
    """The type of a history of such messages: theirs, or float32 if that holds less than the flags need."""
    return torch.promote_types(encoded.dtype, torch.float32)
