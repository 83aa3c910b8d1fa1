"""A transform that lets an agent observe its own latest actions (paper, section 3.3)."""

from collections.abc import Collection
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.nn.functional import pad
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from damian.common import checks
from damian.common.tensors import gather_rows, where_rows
from damian.keys import next_key
from damian.transforms.action import ActionTransform
from damian.transforms.base import Change, Correction, Memory
from damian.transforms.entries import Entries, add_spec, existing, sibling_key


class ActionHistory(ActionTransform):
    """Lets an agent observe its own latest actions, which make a delayed environment Markovian
    again.

    It records actions as the policy chose them, so it must come after transforms that delay or hold
    actions.
    The latest action comes last. Sources: Katsikopoulos and Engelbrecht (2003); paper, section 3.3.

    Args:
        steps: number of actions.
        action_key: key of the action.
        out_key: key of the history, [..., steps * A] float32. A bare name, here and below, means an
            entry beside the action.
        append_to: key of an entry to which the history is appended in its own type, instead of
            ``out_key``.
        codes: vectors that represent discrete actions, [n_actions, A]; if not given, actions are
            scaled to [0, 1].
        default: action that fills the history at first, as in ``ActionDelay``.
        recorded_key: key of a flag in the policy's input, [...] bool: which actions are recorded;
            if not given, all.
        age_key: key of the age of the observation [steps], [..., 1], as ``ObservationDelay`` writes
            it. Actions that the observation reflects already are then replaced by the default.
        reflected_after: an observation reflects an action that was chosen at least this many steps
            before.

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
        self.age_key = sibling_key(self.action_key, age_key)
        self.reflected_after = reflected_after
        self.step_keys = existing([*self.in_keys, self.age_key])

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        _, initial, low, width, _ = self.actions
        initial, low, width = (self.action_rows(value) for value in (initial, low, width))
        scale = {"low": low, "width": width}
        if self.codes is not None:
            scale = {"codes": self.codes.to(initial.device, torch.float32)}
        first = self._encode(scale, initial).repeat(1, self.steps)
        memory = scale | {"first": first, "recent": first}
        if self.age_key:  # steps since each recorded action was chosen
            memory["since"] = torch.zeros(
                len(first), self.steps, dtype=torch.long, device=first.device
            )
        return memory

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        first = memory["first"]
        memory = memory | {"recent": where_rows(mask, first, memory["recent"])}
        return self.on_step(memory, entries)

    def on_action(self, memory: Memory, entries: Entries) -> Change:
        recent = memory["recent"]
        latest = self._encode(memory, self.to_rows(entries[self.action_key]))
        changed = {"recent": torch.cat([recent[:, latest.shape[-1] :], latest], -1)}
        unchanged = {"recent": recent}
        if self.age_key:
            older = memory["since"] + 1
            changed["since"] = torch.cat([older[:, 1:], torch.ones_like(older[:, :1])], -1)
            unchanged["since"] = older
        if self.recorded_key is not None:
            recorded = entries[self.recorded_key].reshape(-1, 1)
            changed = {
                name: torch.where(recorded, new, unchanged[name]) for name, new in changed.items()
            }
        return memory | changed, {}

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        recent = memory["recent"]
        key = self.out_keys[0]
        if self.age_key:
            # An observation of this age was generated ``since - age`` steps after the action was
            # chosen.
            since_chosen = memory["since"] - entries[self.age_key].reshape(-1, 1)
            not_reflected = since_chosen < self.reflected_after
            width = recent.shape[-1] // self.steps
            recent = torch.where(
                not_reflected.repeat_interleave(width, -1), recent, memory["first"]
            )
        history = self.from_rows(recent)
        if key not in entries:
            return memory, {
                key: history.clone()
            }  # others may change it in place, but not the memory
        return memory, {key: torch.cat([entries[key], history.to(entries[key].dtype)], -1)}

    def hindsight(self, keys: Collection[NestedKey]) -> Correction | None:
        """Keeps the stored past actions, as the last columns of an entry that is computed again."""
        appended = [next_key(key) for key in self.in_keys if key in keys]
        if not appended:
            return None

        def keep_actions(entries: Entries, steps: TensorDictBase, count: Tensor) -> Entries:
            key = appended[0]
            return entries | {
                key: torch.cat([entries[key], steps[key][..., entries[key].shape[-1] :]], -1)
            }

        return Correction(keep_actions)

    def _encode(self, scale: Memory, action: Tensor) -> Tensor:
        """Represent actions [M, ...] by vectors [M, A] float32."""
        if self.codes is not None:
            return gather_rows(scale["codes"], action)
        return ((action.float() - scale["low"]) / scale["width"]).reshape(len(action), -1)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        actions = self.actions
        key = self.out_keys[0]
        codes = self.codes
        rows = actions.rows
        initial = actions.initial
        numbers = initial.shape[len(rows) :].numel() if codes is None else codes.shape[-1]
        width = self.steps * numbers
        if not self.in_keys:
            add_spec(observation_spec, key, (*rows, width))
            return observation_spec
        old = observation_spec[key]
        flat = old.dtype.is_floating_point and len(old.shape) == len(rows) + 1
        checks.require(
            flat,
            "append_to",
            key,
            "is not a vector of floats, so no actions can be appended to it; use out_key instead",
        )
        observation_spec[key] = self._appended(old, width)
        return observation_spec

    def _appended(self, old: TensorSpec, width: int) -> TensorSpec:
        """The spec ``old`` with ``width`` more columns for the history; bounded if all of them
        are."""
        shape = torch.Size((*old.shape[:-1], old.shape[-1] + width))
        if not isinstance(old, Bounded) or (self.codes is None and not self.actions.bounded):
            return Unbounded(shape, dtype=old.dtype, device=old.device)
        lowest, highest = 0.0, 1.0
        if self.codes is not None:
            lowest, highest = (code.item() for code in self.codes.aminmax())
        low = pad(old.low, (0, width), value=lowest)
        high = pad(old.high, (0, width), value=highest)
        return Bounded(low, high, shape=shape, dtype=old.dtype, device=old.device)
