"""An agent's memory of what it has done."""

from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded

from damian.common import checks
from damian.common.tensors import expand_mask, gather_rows
from damian.transforms.action_specs import ActionTransform
from damian.transforms.entries import Change, Entries, Memory, as_rows, from_rows, sibling_key
from damian.transforms.order import KeyUsage


class ActionHistory(ActionTransform):
    """Shows an agent its own latest actions: with them a delayed environment is Markovian again.

    What it records is what was chosen, so it comes after whatever delays or holds actions. The latest
    action comes last (Katsikopoulos and Engelbrecht, 2003; the paper, section 3.3).

    Args:
        steps: how many actions.
        action_key: the action.
        out_key: where they are shown, [..., steps * A]; beside the action, if a bare name.
        append_to: an entry to whose end they are put instead.
        codes: how discrete actions are shown, a row each, [n_actions, A]; if not given, all actions are
            scaled to [0, 1] (one-hot ones are shown as they are).
        default: the actions before the first: a number, or an action's values; 0, or the nearest to it, if
            not given.
        recorded_key: flag that the policy sees: only where it is true is the action recorded, [...] bool;
            beside the action, if a bare name.
        age_key: age of what the agent is shown [steps], [..., 1] (``ObservationDelay``): only actions chosen
            since then are shown, in place of older ones, of which that knows already, the default.
    """

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
    ) -> None:
        checks.whole("steps", steps, 1)
        super().__init__(action_key, default)
        appended = [append_to] if append_to is not None else []
        self.in_keys, self.out_keys = appended, appended or [sibling_key(self.action_key, out_key)]
        self.steps, self.recorded_key = steps, sibling_key(self.action_key, recorded_key)
        self.codes = codes
        self.action_keys = [self.action_key, *([self.recorded_key] if self.recorded_key else [])]
        self.age_key = sibling_key(self.action_key, age_key)
        self._reads = [self.age_key] if self.age_key else []
        self.step_keys = [*self.in_keys, *self._reads]

    @property
    def key_usage(self) -> KeyUsage:
        return KeyUsage(reads=self._reads, appends=self.in_keys, records=[self.action_key])

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        actions = self.actions
        scale = {"low": actions.low, "width": actions.width}
        scale |= {} if self.codes is None else {"codes": self.codes.to(actions.initial.device)}
        first = self._encode(scale, actions.initial).repeat(1, self.steps)
        since = torch.zeros(len(first), self.steps, dtype=torch.long, device=first.device)
        return scale | {"first": first, "recent": first, "since": since}

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        first = memory["first"]
        memory = memory | {"recent": torch.where(expand_mask(mask, first), first, memory["recent"])}
        return self.on_step(memory, entries)

    def on_action(self, memory: Memory, entries: Entries) -> Change:
        recent = memory["recent"]
        latest = self._encode(memory, as_rows(entries[self.action_key], self.rows))
        longer = torch.cat([recent[:, latest.shape[-1] :], latest], -1)
        old, new = memory["since"], torch.ones_like(memory["since"][:, :1])
        since = torch.cat([old[:, 1:] + 1, new], -1)
        if self.recorded_key in entries:
            recorded = entries[self.recorded_key].reshape(-1, 1)
            longer, since = torch.where(recorded, longer, recent), torch.where(recorded, since, old + 1)
        return memory | {"recent": longer, "since": since}, {}

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        recent, key = memory["recent"], self.out_keys[0]
        if self.age_key:
            unknown = memory["since"] <= entries[self.age_key].reshape(-1, 1)
            width = recent.shape[-1] // self.steps
            recent = torch.where(unknown.repeat_interleave(width, -1), recent, memory["first"])
        shown = from_rows(recent, self.rows)
        return memory, {key: torch.cat([entries[key], shown], -1) if key in entries else shown}

    def _encode(self, scale: Memory, action: Tensor) -> Tensor:
        """Actions [M, ...] as numbers [M, A]."""
        if self.codes is not None:
            return gather_rows(scale["codes"], action)
        return ((action.float() - scale["low"]) / scale["width"]).view(len(action), -1).float()

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        example = self.actions.initial[:1]
        width = self.steps * (example.numel() if self.codes is None else self.codes.shape[-1])
        key, device = self.out_keys[0], observation_spec.device
        if not self.in_keys:
            observation_spec[key] = Unbounded(torch.Size((*self.actions.rows, width)), device=device)
            return observation_spec
        old = observation_spec[key]
        flat = old.dtype.is_floating_point and len(old.shape) == len(self.actions.rows) + 1
        should = "is no row of floats, to which actions could be appended; take out_key instead"
        checks.require(flat, "append_to", key, should)
        shape = torch.Size((*old.shape[:-1], old.shape[-1] + width))
        observation_spec[key] = Unbounded(shape, dtype=old.dtype, device=device)
        return observation_spec
