"""Transforms that let an agent observe its latest actions (paper, section 3.3), and late messages."""

from collections.abc import Callable, Collection
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from damian.common import checks
from damian.common.tensors import expand_mask, gather_rows
from damian.keys import next_key
from damian.transforms.action import ActionTransform
from damian.transforms.base import (
    Change,
    Correction,
    Entries,
    Memory,
    StatefulTransform,
    add_spec,
    as_rows,
    existing,
    from_rows,
    sibling_key,
    spec_rows,
)

_NEVER = 2**31
"""Steps until the arrival of a message that never arrives."""


class ActionHistory(ActionTransform):
    """Lets an agent observe its own latest actions, which make a delayed environment Markovian again.

    It records actions as the policy chose them, so it must come after transforms that delay or hold actions.
    The latest action comes last. Sources: Katsikopoulos and Engelbrecht (2003); paper, section 3.3.

    Args:
        steps: number of actions.
        action_key: key of the action.
        out_key: key of the history, [..., steps * A] float32. A bare name, here and below, means an entry
            beside the action.
        append_to: key of an entry to which the history is appended in its own type, instead of ``out_key``.
        codes: vectors that represent discrete actions, [n_actions, A]; if not given, actions are scaled to
            [0, 1].
        default: action that fills the history at first, as in ``ActionDelay``.
        recorded_key: key of a flag in the policy's input, [...] bool: which actions are recorded; if not
            given, all.
        age_key: key of the age of the observation [steps], [..., 1], as ``ObservationDelay`` writes it.
            Actions that the observation reflects already are then replaced by the default.
        reflected_after: an observation reflects an action that was chosen at least this many steps before.

    Examples:
        >>> history = ActionHistory(2, append_to="observation")
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(ActionDelay(2), history))
        >>> env.rollout(100)["observation"]  # the last two columns are the last two actions
    """

    stage = "history"

    def __init__(
        self,
        steps: int,
        action_key: NestedKey = "action",
        *,
        out_key: NestedKey = "action_history",
        append_to: NestedKey | None = None,
        codes: Tensor | None = None,
        default: Any = None,
        recorded_key: NestedKey | None = None,
        age_key: NestedKey | None = None,
        reflected_after: int = 1,
    ) -> None:
        checks.whole("steps", steps, 1)
        checks.whole("reflected_after", reflected_after, 1, unit="steps")
        super().__init__(action_key, default)
        appended = [append_to] if append_to is not None else []
        self.in_keys, self.out_keys = appended, appended or [sibling_key(self.action_key, out_key)]
        self.steps, self.recorded_key = steps, sibling_key(self.action_key, recorded_key)
        self.codes = codes
        self.action_keys = existing([self.action_key, self.recorded_key])
        self.age_key, self.reflected_after = sibling_key(self.action_key, age_key), reflected_after
        self.step_keys = existing([*self.in_keys, self.age_key])

    @property
    def _n_numbers(self) -> int:
        """Number of numbers that represent an action, A."""
        rows, initial = self.actions.rows, self.actions.initial
        return initial.shape[len(rows) :].numel() if self.codes is None else self.codes.shape[-1]

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        _, initial, low, width, _ = self.actions
        initial, low, width = (self.action_rows(value) for value in (initial, low, width))
        scale = {"low": low, "width": width}
        if self.codes is not None:
            scale = {"codes": self.codes.to(initial.device, torch.float32)}
        first = self._encode(scale, initial).repeat(1, self.steps)
        memory = scale | {"first": first, "recent": first}
        if self.age_key:  # steps since each recorded action was chosen
            memory["since"] = torch.zeros(len(first), self.steps, dtype=torch.long, device=first.device)
        return memory

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        first = memory["first"]
        memory = memory | {"recent": torch.where(expand_mask(mask, first), first, memory["recent"])}
        return self.on_step(memory, entries)

    def on_action(self, memory: Memory, entries: Entries) -> Change:
        recent = memory["recent"]
        latest = self._encode(memory, as_rows(entries[self.action_key], self.rows))
        changed = {"recent": torch.cat([recent[:, latest.shape[-1] :], latest], -1)}
        unchanged = {"recent": recent}
        if self.age_key:
            older = memory["since"] + 1
            changed["since"] = torch.cat([older[:, 1:], torch.ones_like(older[:, :1])], -1)
            unchanged["since"] = older
        if self.recorded_key is not None:
            recorded = entries[self.recorded_key].reshape(-1, 1)
            changed = {name: torch.where(recorded, new, unchanged[name]) for name, new in changed.items()}
        return memory | changed, {}

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        recent, key = memory["recent"], self.out_keys[0]
        if self.age_key:
            # An observation of this age was generated ``since - age`` steps after the action was chosen.
            since_chosen = memory["since"] - entries[self.age_key].reshape(-1, 1)
            not_reflected = since_chosen < self.reflected_after
            width = recent.shape[-1] // self.steps
            recent = torch.where(not_reflected.repeat_interleave(width, -1), recent, memory["first"])
        history = from_rows(recent, self.rows)
        if key not in entries:
            return memory, {key: history.clone()}  # others may change it in place, but not the memory
        return memory, {key: torch.cat([entries[key], history.to(entries[key].dtype)], -1)}

    def after_idle_steps(self, memory: Memory, n_steps: int) -> Memory:
        return memory | {"since": memory["since"] + n_steps} if self.age_key else memory

    def hindsight(self, keys: Collection[NestedKey]) -> Correction | None:
        """Keeps the stored past actions, as the last columns of an entry that is computed again."""
        appended = [next_key(key) for key in self.in_keys if key in keys]
        if not appended:
            return None

        def keep_actions(entries: Entries, steps: TensorDictBase, count: Tensor) -> Entries:
            key = appended[0]
            return entries | {key: torch.cat([entries[key], steps[key][..., entries[key].shape[-1] :]], -1)}

        return Correction(keep_actions)

    def _encode(self, scale: Memory, action: Tensor) -> Tensor:
        """Represent actions [M, ...] by vectors [M, A] float32."""
        if self.codes is not None:
            return gather_rows(scale["codes"], action)
        return ((action.float() - scale["low"]) / scale["width"]).reshape(len(action), -1)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        rows, width = self.actions.rows, self.steps * self._n_numbers
        key = self.out_keys[0]
        if not self.in_keys:
            add_spec(observation_spec, key, (*rows, width))
            return observation_spec
        old = observation_spec[key]
        flat = old.dtype.is_floating_point and len(old.shape) == len(rows) + 1
        should = "is not a vector of floats, so no actions can be appended to it; use out_key instead"
        checks.require(flat, "append_to", key, should)
        observation_spec[key] = self._appended(old, width)
        return observation_spec

    def _appended(self, old: TensorSpec, width: int) -> TensorSpec:
        """The spec ``old`` with ``width`` more columns for the history; bounded if all of them are."""
        shape = torch.Size((*old.shape[:-1], old.shape[-1] + width))
        if not isinstance(old, Bounded) or (self.codes is None and not self.actions.bounded):
            return Unbounded(shape, dtype=old.dtype, device=old.device)
        if self.codes is None:
            lowest, highest = torch.zeros(width), torch.ones(width)
        else:
            lowest, highest = (code.repeat(self.steps) for code in self.codes.aminmax(dim=0))
        low, high = (
            torch.cat([bound, added.to(bound).expand(*shape[:-1], width)], -1)
            for bound, added in ((old.low, lowest), (old.high, highest))
        )
        return Bounded(low, high, shape=shape, dtype=old.dtype, device=old.device)


class MessageHistory(StatefulTransform):
    """Writes the messages of the latest steps that have arrived, those that came late or out of order too.

    It comes after ``ObservationDelay(..., delay_key=...)``, which draws the delays. A row of the history has
    D + 3 numbers: those of the message, 0 before it arrives; whether it has arrived; its age over ``steps``;
    and whether it is the receiver's own. The newest message comes first. The message of a reset arrives at
    once.

    Args:
        steps: number of latest steps, K.
        message_key: key of the message of a step, [..., D].
        out_key: key of the history, [..., L, D + 3], float32, or float64 as the messages; L is K, or N K with
            ``group``. A bare name, here and below, means an entry beside the message.
        delay_key: key of the delay of the message sent in this step [steps], [..., 1], -1 if it never
            arrives; None if messages are not delayed.
        sent_key: key of a flag, [...] bool: which rows send a message in this step; if not given, all do.
        encode: function from messages [..., M] to the D numbers to keep; if not given, these are the message.
        group: every agent gets the messages of all agents: its own first, then those of the agents after it.
        own: whether an agent knows its own messages as soon as they are sent.

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
        self.step_keys = existing([self.row_key, self.delay_key, self.sent_key])

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
        """Note the message [...] of an agent that arrives in the next step, ``lag`` >= 1 steps late."""
        if lag > self.steps:
            return memory
        row = {"kept": self._encoded(message.view(1, 1, -1)).view(-1), "due": 1, "sent": True}
        memory = memory | {name: memory[name].clone() for name in row}
        for name, value in row.items():
            memory[name][agent, lag - 1] = value
        return memory

    def _added(self, memory: Memory, message: Tensor, due: Tensor, sent: Tensor) -> Memory:
        """The memory with the messages [*rows, ...] of a step, ``due`` [M] steps later, as the newest."""
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
        spec, rows = observation_spec[self.row_key], spec_rows(observation_spec, self.row_key)
        encoded = self._encoded(spec.zero())
        shape = (*rows, self.steps * (rows[-1] if self.group else 1), encoded.shape[-1] + 3)
        dtype = torch.promote_types(encoded.dtype, torch.float32)
        add_spec(observation_spec, self.out_keys[0], shape, dtype)
        return observation_spec
