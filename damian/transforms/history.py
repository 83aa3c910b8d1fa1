"""An agent's memory of what it has done."""

from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Composite, Unbounded

from damian import checks
from damian.compiling import compiled
from damian.transforms.action import OnActions
from damian.transforms.stateful import Order, beside, flag_rows, wide
from damian.world.airspace import rows


class ActionHistory(OnActions):
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
    """

    first: Tensor
    """Shown after a reset, [M, steps * A]."""
    recent: Tensor
    """Shown now, likewise."""

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
    ) -> None:
        checks.in_range("steps", steps, 1)
        super().__init__(action_key, default)
        appended = [append_to] if append_to is not None else []
        self.in_keys, self.out_keys = appended, appended or [beside(self.action_key, out_key)]
        self.steps, self.recorded_key = steps, beside(self.action_key, recorded_key)
        self.register_buffer("first", None)
        self.register_buffer("recent", None)
        self.codes = None if codes is None else nn.Buffer(codes, persistent=False)
        self._advance = self._remember

    @property
    def order(self) -> Order:
        return Order(appends=self.in_keys, records=[self.action_key])

    def compile(self) -> None:  # type: ignore[override]
        """Compile what a step computes."""
        self._advance = compiled(self._remember)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        mask = flag_rows(tensordict, "_reset", self.action_key, self.actions.rows)
        if self.first is None:
            self.first = self._encode(self.actions.initial).repeat(1, self.steps)
        if self.recent is None or mask is None:
            self.recent = self.first
        else:
            self.recent = torch.where(wide(mask, self.first), self.first, self.recent)
        return self._show(tensordict_reset)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.container is None or self.recent is None:
            self._refuse()
        taken = self._flag(tensordict, self.recorded_key)
        if taken is None:
            taken = torch.ones(len(self.recent), dtype=torch.bool, device=self.recent.device)
        self.recent = self._advance(self.recent, self._chosen(tensordict), taken)
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._show(next_tensordict)

    def _show(self, tensordict: TensorDictBase) -> TensorDictBase:
        shown = self.recent.view(*self.actions.rows, -1)
        if self.in_keys:
            shown = torch.cat([tensordict.get(self.in_keys[0]), shown], -1)
        return tensordict.set(self.out_keys[0], shown)

    def _remember(self, recent: Tensor, action: Tensor, taken: Tensor) -> Tensor:
        """Push the latest action in, and the oldest out, [M, steps * A]."""
        latest = self._encode(action)
        longer = torch.cat([recent[:, latest.shape[-1] :], latest], -1)
        return torch.where(wide(taken, longer), longer, recent)

    def _encode(self, action: Tensor) -> Tensor:
        """Actions [M, ...] as numbers [M, A]."""
        if self.codes is not None:
            return rows(self.codes, action)
        scaled = (action - self.actions.low) / self.actions.width
        return scaled.view(len(action), -1).float()

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        width = self.steps * self._encode(self.actions.initial).shape[-1]
        key, device = self.out_keys[0], observation_spec.device
        if not self.in_keys:
            observation_spec[key] = Unbounded(torch.Size((*self.actions.rows, width)), device=device)
            return observation_spec
        old = observation_spec[key]
        shape = torch.Size((*old.shape[:-1], old.shape[-1] + width))
        observation_spec[key] = Unbounded(shape, dtype=old.dtype, device=device)
        return observation_spec
