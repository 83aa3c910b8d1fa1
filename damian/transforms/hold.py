"""Transforms for clocks that are slower than the environment's (paper, section 3.6), and skipped steps."""

from collections.abc import Collection, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from damian import keys
from damian.common import checks
from damian.common.tensors import expand_mask
from damian.delays.laws import Delay, in_steps
from damian.keys import next_key
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
    select_entries,
    sibling_key,
)


class SampleAndHold(StatefulTransform):
    """Samples entries at the ticks of a slow clock, and holds them in between (paper, section 3.6).

    The clock ticks every ``period`` steps, and at every reset. Between two ticks, the entries ``in_keys``
    keep the values of the last tick, and the environment executes the actions ``in_keys_inv`` of the last
    tick again.

    A worked timeline, with a period of 3 steps: the clock ticks at t = 0, 3 and 6. The observation of t = 0
    is shown at t = 0, 1 and 2, and that of t = 3 at t = 3, 4 and 5. The action chosen at t = 0 is executed in
    the steps that begin at t = 0, 1 and 2, whatever is chosen at t = 1 and 2.

    Args:
        period: time between two ticks: steps (``4``), or a time (``"2s"``).
        in_keys, in_keys_inv: keys of the entries that are sampled and held, and of the actions that are held.
        ready_key: key of a flag, [...] bool, that is set to false between two ticks; or None.
        age_key: key of the age of the held entries [steps], [..., 1], which grows between two ticks; or None.
            A bare name means an entry beside ``in_keys[0]``.
        dt: length of a step [s], for a period given as a time.

    Examples:
        >>> clock = SampleAndHold(4, ["observation"], ["action"])
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), clock)  # the agent acts in every fourth step
    """

    def __init__(
        self,
        period: Delay,
        in_keys: NestedKey | Sequence[NestedKey] = "observation",
        in_keys_inv: NestedKey | Sequence[NestedKey] = (),
        *,
        ready_key: NestedKey | None = None,
        age_key: NestedKey | None = None,
        dt: float = 1.0,
    ) -> None:
        super().__init__(in_keys, in_keys, in_keys_inv, in_keys_inv)
        should = "is empty, and so is in_keys_inv: name the entries or the actions to hold"
        checks.require(bool(self.in_keys or self.in_keys_inv), "in_keys", in_keys, should)
        checks.above("dt", dt, 0.0, "s")
        self.period = in_steps("period", period, dt)
        checks.in_range("period", self.period, 1, unit="steps")
        self.ready_key, self.age_key = ready_key, sibling_key(self.row_key, age_key)
        self.action_keys = self.in_keys_inv
        self.step_keys = existing([*self.in_keys, ready_key, self.age_key])

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        first = select_entries(tensordict, self.in_keys)
        device = next((value.device for value in first.values()), self.env.device)
        memory = {"elapsed": torch.zeros(self.rows.numel(), dtype=torch.long, device=device)}  # since a tick
        memory |= {f"held_{i}": as_rows(value, self.rows) for i, value in enumerate(first.values())}
        specs = self.env.full_action_spec
        for i, key in enumerate(self.in_keys_inv):
            memory[f"action_at_tick_{i}"] = self.as_rows_of_spec(specs[key].zero(), specs, key)
        if self.age_key:
            memory["age"] = as_rows(tensordict.get(self.age_key), self.rows)
        return memory

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        memory = memory | {"elapsed": memory["elapsed"].masked_fill(mask, 0)}
        return self._hold_entries(memory, entries, mask, 0)

    def on_action(self, memory: Memory, entries: Entries) -> Change:
        return self._hold(memory, entries, self.in_keys_inv, "action_at_tick", memory["elapsed"] == 0)

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        elapsed = memory["elapsed"] + 1
        ticks = elapsed >= self.period
        memory, held = self._hold_entries(
            memory | {"elapsed": elapsed.masked_fill(ticks, 0)}, entries, ticks, 1
        )
        if self.ready_key:
            ready = entries[self.ready_key]
            held[self.ready_key] = ready & ticks.view_as(ready)
        return memory, held

    def after_idle_steps(self, memory: Memory, n_steps: int) -> Memory:
        aged = {"age": memory["age"] + n_steps} if self.age_key else {}
        return memory | {"elapsed": (memory["elapsed"] + n_steps) % self.period} | aged

    def _hold_entries(self, memory: Memory, entries: Entries, sampled: Tensor, n_steps: int) -> Change:
        """Hold the entries ``in_keys``; where they are not sampled, their age grows by ``n_steps``."""
        memory, held = self._hold(memory, entries, self.in_keys, "held", sampled)
        if self.age_key:
            new = as_rows(entries[self.age_key], self.rows)
            age = torch.where(expand_mask(sampled, new), new, memory["age"] + n_steps)
            memory, held[self.age_key] = memory | {"age": age}, from_rows(age, self.rows).clone()
        return memory, held

    def _hold(
        self, memory: Memory, entries: Entries, keys: Sequence[NestedKey], name: str, sampled: Tensor
    ) -> Change:
        """Sample the entries where the mask [M] is true, and output the held values everywhere."""
        outputs: Entries = {}
        for i, key in enumerate(keys):
            new, old = as_rows(entries[key], self.rows), memory[f"{name}_{i}"]
            held = torch.where(expand_mask(sampled, new), new, old)
            memory = memory | {f"{name}_{i}": held}
            outputs[key] = from_rows(held, self.rows).clone()  # the memory keeps the held values
        return memory, outputs

    def hindsight(self, keys: Collection[NestedKey]) -> Correction | None:
        """Keeps entries, between two ticks, as they are known by now for the latest tick."""
        held = [key for key in self.in_keys if key in keys]
        if not held or self.period == 1:
            return None

        def hold_again(entries: Entries, steps: TensorDictBase, count: Tensor) -> Entries:
            elapsed = count + 1
            index = torch.arange(len(count), device=count.device).unsqueeze(-1)
            tick, world = index - elapsed % self.period, torch.arange(count.shape[1], device=count.device)
            # Nothing is late at a reset: what was held until the first tick after it stays.
            stays, corrected = (elapsed < self.period) | (tick < 0), dict(entries)
            for key in map(next_key, held):
                value = entries[key]
                stored = steps[key][..., : value.shape[-1]]
                at_tick = value[tick.clamp(min=0), world]
                corrected[key] = torch.where(expand_mask(stays, value), stored, at_tick)
            return corrected

        return Correction(hold_again, lookback=self.period - 1)


class SkipUntilReady(StatefulTransform):
    """Steps each world until some agent can choose an action again, or the episode ends (``clock.skip``).

    The outputs equal, bit for bit, those of stepping until then with actions that no agent executes. Only the
    rewards ``reward_keys`` are the sums of gamma^k r_k over the merged steps k = 0, 1, ..., and ``duration``,
    [B, 1] long, is the number of these steps (0 after a reset), as in a semi-Markov decision process (Sutton,
    Precup and Singh, 1999).

    It works only in a ``DelayedEnv`` on a ``UavEnv``, before all transforms that are not damian's. Transforms
    of TorchRL that come later process only the merged steps: ``StepCounter`` counts decisions.
    """

    per_world = True

    def __init__(self, gamma: float = 1.0, reward_keys: Sequence[NestedKey] = (keys.REWARD,)) -> None:
        checks.in_range("gamma", gamma, 0.0, 1.0)
        super().__init__(out_keys=[keys.DURATION])
        self.gamma, self.reward_keys = gamma, list(reward_keys)
        self.step_keys = [keys.DONE]

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        return memory, {keys.DURATION: torch.zeros_like(entries[keys.DONE], dtype=torch.long)}

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        return memory, {keys.DURATION: torch.ones_like(entries[keys.DONE], dtype=torch.long)}

    def skipped_worlds(self, entries: Entries) -> Tensor:
        """Worlds in which no agent is ready after a step and the episode goes on, [B] bool."""
        ready, done = entries[keys.READY], entries[keys.DONE]
        return ~(ready.flatten(1).any(-1) | done.view(-1))

    def merge_steps(self, entries: Entries, later: Entries, stepped: Tensor) -> Entries:
        """Merge the outputs of a later step into ``entries`` in the worlds ``stepped`` [B] that took it."""
        duration = entries[keys.DURATION]
        weight = (self.gamma**duration).view(-1)
        sums = {k: entries[k] + expand_mask(weight, later[k]) * later[k] for k in self.reward_keys}
        later = later | sums | {keys.DURATION: duration + 1}
        return {key: torch.where(expand_mask(stepped, new), new, entries[key]) for key, new in later.items()}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        raise RuntimeError(
            "SkipUntilReady works only in a DelayedEnv on a UavEnv, before all transforms that are not "
            "damian's, and only if all worlds step: the TensorDict must contain neither '_step' nor 'next'"
        )

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        add_spec(observation_spec, keys.DURATION, (*observation_spec.shape, 1), torch.long)
        return observation_spec
