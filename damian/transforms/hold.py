"""A transform for clocks that are slower than the environment's (paper, section 3.6)."""

from collections.abc import Collection, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from damian.common import checks
from damian.common.tensors import where_rows
from damian.delays.laws import Delay, in_steps
from damian.keys import next_key
from damian.transforms.base import Change, Correction, Memory, StatefulTransform
from damian.transforms.entries import Entries, Keys, existing, select_entries


class SampleAndHold(StatefulTransform):
    """Samples entries at the ticks of a slow clock, and holds them in between (paper, section 3.6).

    The clock ticks every ``period`` steps, and at every reset. Between two ticks, the entries
    ``in_keys`` keep the values of the last tick, and the environment executes the actions
    ``in_keys_inv`` of the last tick again.

    A worked timeline, with a period of 3 steps: the clock ticks at t = 0, 3 and 6. The observation
    of t = 0 is shown at t = 0, 1 and 2, and that of t = 3 at t = 3, 4 and 5. The action chosen at t
    = 0 is executed in the steps that begin at t = 0, 1 and 2, whatever is chosen at t = 1 and 2.

    Args:
        period: time between two ticks: steps (``4``), or a time (``"2s"``).
        in_keys, in_keys_inv: keys of the entries that are sampled and held, and of the actions that
            are held.
        ready_key: key of a flag, [...] bool, that is set to false between two ticks; or None.
        dt: length of a step [s], for a period given as a time.

    Examples:
        >>> clock = SampleAndHold(4, ["observation"], ["action"])
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), clock)  # the agent acts in every fourth step
    """

    def __init__(
        self,
        period: Delay,
        in_keys: Keys = "observation",
        in_keys_inv: Keys = (),
        *,
        ready_key: NestedKey | None = None,
        dt: float = 1.0,
    ) -> None:
        super().__init__(in_keys, in_keys, in_keys_inv, in_keys_inv)
        checks.require(
            bool(self.in_keys or self.in_keys_inv),
            "in_keys",
            in_keys,
            "is empty, and so is in_keys_inv: name the entries or the actions to hold",
        )
        checks.above("dt", dt, 0.0, "s")
        self.period = in_steps("period", period, dt)
        checks.in_range("period", self.period, 1, unit="steps")
        self.ready_key = ready_key
        self.action_keys = self.in_keys_inv
        self.step_keys = existing([*self.in_keys, ready_key])

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        first = select_entries(tensordict, self.in_keys)
        device = next((value.device for value in first.values()), self.env.device)
        memory = {
            "elapsed": torch.zeros(self.rows.numel(), dtype=torch.long, device=device)
        }  # since a tick
        memory |= {f"held_{i}": self.to_rows(value) for i, value in enumerate(first.values())}
        specs = self.env.full_action_spec
        for i, key in enumerate(self.in_keys_inv):
            memory[f"action_at_tick_{i}"] = self.as_rows_of_spec(specs[key].zero(), specs, key)
        return memory

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        memory = memory | {"elapsed": memory["elapsed"].masked_fill(mask, 0)}
        return self._hold(memory, entries, self.in_keys, "held", mask)

    def on_action(self, memory: Memory, entries: Entries) -> Change:
        return self._hold(
            memory, entries, self.in_keys_inv, "action_at_tick", memory["elapsed"] == 0
        )

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        elapsed = memory["elapsed"] + 1
        ticks = elapsed >= self.period
        memory = memory | {"elapsed": elapsed.masked_fill(ticks, 0)}
        memory, held = self._hold(memory, entries, self.in_keys, "held", ticks)
        if self.ready_key:
            ready = entries[self.ready_key]
            held[self.ready_key] = ready & ticks.view_as(ready)
        return memory, held

    def _hold(
        self,
        memory: Memory,
        entries: Entries,
        keys: Sequence[NestedKey],
        name: str,
        sampled: Tensor,
    ) -> Change:
        """Sample the entries where the mask [M] is true, and output the held values everywhere."""
        outputs = {}
        for i, key in enumerate(keys):
            new = self.to_rows(entries[key])
            held = where_rows(sampled, new, memory[f"{name}_{i}"])
            memory = memory | {f"{name}_{i}": held}
            outputs[key] = self.from_rows(held).clone()  # the memory keeps the held values
        return memory, outputs

    def hindsight(self, keys: Collection[NestedKey]) -> Correction | None:
        """Keeps entries, between two ticks, as they are known by now for the latest tick."""
        held = [key for key in self.in_keys if key in keys]
        if not held or self.period == 1:
            return None

        def hold_again(entries: Entries, steps: TensorDictBase, count: Tensor) -> Entries:
            elapsed = count + 1
            index = torch.arange(len(count), device=count.device).unsqueeze(-1)
            tick = index - elapsed % self.period
            world = torch.arange(count.shape[1], device=count.device)
            # Nothing is late at a reset: what was held until the first tick after it stays.
            stays = (elapsed < self.period) | (tick < 0)
            corrected = dict(entries)
            for key in map(next_key, held):
                value = entries[key]
                stored = steps[key][..., : value.shape[-1]]
                at_tick = value[tick.clamp(min=0), world]
                corrected[key] = where_rows(stays, stored, at_tick)
            return corrected

        return Correction(hold_again, lookback=self.period - 1)
