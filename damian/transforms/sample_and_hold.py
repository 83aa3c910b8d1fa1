"""A transform for agents and servers whose clocks are slower than the environment's (paper, section 3.6)."""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from damian.common import checks, counter_rng
from damian.common.tensors import expand_mask
from damian.delays.laws import Delay, in_steps
from damian.transforms.base import StatefulTransform
from damian.transforms.batches import expand_to_rows
from damian.transforms.entries import (
    Change,
    Entries,
    Memory,
    as_rows,
    from_rows,
    select_entries,
    sibling_key,
    spec_rows,
)
from damian.transforms.order import KeyUsage


class SampleAndHold(StatefulTransform):
    """Samples entries at the ticks of a slow clock, and holds them in between (paper, section 3.6).

    The clock ticks every ``period`` steps, and at every reset. Between two ticks, the entries ``in_keys``
    keep the values of the last tick, and the environment executes the actions ``in_keys_inv`` of the last
    tick again. With a period of one step nothing changes.

    Args:
        period: time between two ticks: steps (``4``), or a time (``"2s"``).
        in_keys: keys of the entries that are sampled and held; their TensorDicts have the same batch size.
        in_keys_inv: keys of the actions that are held, of the same batch size too: an action chosen between
            two ticks is not executed.
        ready_key: key of a flag, [...] bool, that is set to false between two ticks, as an agent cannot
            choose then; None to leave it out.
        age_key: key of the age of the entries that are held [steps], [..., 1], as ``ObservationDelay`` writes
            it: between two ticks it grows by one in each step. A bare name means an entry in the same
            TensorDict as ``in_keys[0]``; None to leave ages as they are.
        dt: length of a step [s], for a period given as a time.
        stagger: every row (world, or agent under a nested key) draws the time from each reset to its second
            tick, from one step to a period, so that the clocks do not all tick in the same step.
        seed: seed of these draws until the environment is seeded; if there is none, it is drawn from torch's
            global generator at the first reset.
        gradients: let gradients flow through the held entries (``StatefulTransform``).

    Raises:
        InputError: the period is not valid, no key is given, or there is an age but no entry is held; at the
            first reset also: the entries and actions have different batch sizes.

    Examples:
        >>> clock = SampleAndHold(4, ["observation"], ["action"])
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), clock)  # the agent acts in every fourth step
    """

    one_level = True

    def __init__(
        self,
        period: Delay,
        in_keys: NestedKey | Sequence[NestedKey] = "observation",
        in_keys_inv: NestedKey | Sequence[NestedKey] = (),
        *,
        ready_key: NestedKey | None = None,
        age_key: NestedKey | None = None,
        dt: float = 1.0,
        stagger: bool = False,
        seed: int | None = None,
        gradients: bool = False,
    ) -> None:
        super().__init__(in_keys, in_keys, in_keys_inv, in_keys_inv, seed, gradients)
        should = "is empty, and so is in_keys_inv: name the entries or the actions to hold"
        checks.require(bool(self.in_keys or self.in_keys_inv), "in_keys", in_keys, should)
        checks.above("dt", dt, 0.0, "s")
        self.period = in_steps("period", period, dt)
        checks.in_range("period", self.period, 1, unit="steps")
        self.ready_key, self.stagger = ready_key, stagger
        should = "is the age of the entries that are held, but in_keys is empty"
        checks.require(bool(self.in_keys) or age_key is None, "age_key", age_key, should)
        self.age_key = sibling_key(self.row_key, age_key)
        self.draws = stagger
        self.action_keys = self.in_keys_inv
        self.step_keys = [*self.in_keys, *(key for key in (ready_key, self.age_key) if key)]

    @property
    def row_key(self) -> NestedKey:
        return [*self.in_keys, *self.in_keys_inv][0]

    @property
    def key_usage(self) -> KeyUsage:
        delayed = [*self.in_keys, *([self.age_key] if self.age_key else [])]
        held = [(key, self.age_key) for key in self.in_keys if self.period > 1]
        return KeyUsage(reads=self.step_keys, delays=delayed, replaces=self.in_keys_inv, holds=held)

    @property
    def memory_sizes(self) -> dict[str, int]:
        n_entries = len(self.in_keys) + (self.age_key is not None)
        return {"period": self.period, "entries": n_entries, "in_keys_inv": len(self.in_keys_inv)}

    @property
    def required_keys(self) -> Sequence[NestedKey]:
        return self.step_keys

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        first = select_entries(tensordict, self.in_keys)
        device = next((value.device for value in first.values()), self.env.device)
        elapsed = torch.zeros(self.rows.numel(), dtype=torch.long, device=device)
        held = {f"held_{i}": as_rows(value, self.rows) for i, value in enumerate(first.values())}
        specs = self.env.full_action_spec
        acted = {
            f"acted_{i}": expand_to_rows(specs[key].zero(), spec_rows(specs, key), self.rows)
            for i, key in enumerate(self.in_keys_inv)
        }
        memory = {"elapsed": elapsed, **held, **acted}  # "elapsed": steps since the latest tick
        if self.age_key:
            memory["age"] = as_rows(tensordict.get(self.age_key), self.rows)
        if not self.stagger:
            return memory
        streams = self.streams(tensordict.batch_size, device)
        names = ("episode", "phase", "interval")  # "interval": steps from the latest tick to the next one
        return memory | {"streams": streams} | {name: elapsed.clone() for name in names}

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        memory = memory | {"elapsed": memory["elapsed"].masked_fill(mask, 0)}
        if self.stagger:
            episode = memory["episode"] + mask
            phase = counter_rng.bits(memory["streams"], episode) % self.period
            new = {"phase": phase, "interval": self.period - phase}
            memory = memory | {name: torch.where(mask, value, memory[name]) for name, value in new.items()}
            memory["episode"] = episode
        memory, held = self._hold(memory, entries, self.in_keys, "held", mask)
        return self._with_age(memory, held, entries, mask, 0)

    def on_action(self, memory: Memory, entries: Entries) -> Change:
        return self._hold(memory, entries, self.in_keys_inv, "acted", memory["elapsed"] == 0)

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        elapsed = memory["elapsed"] + 1
        ticks = elapsed >= memory.get("interval", self.period)
        memory = memory | {"elapsed": elapsed.masked_fill(ticks, 0)}
        if self.stagger:
            memory["interval"] = memory["interval"].masked_fill(ticks, self.period)
        memory, held = self._hold(memory, entries, self.in_keys, "held", ticks)
        if self.ready_key:
            ready = entries[self.ready_key]
            held[self.ready_key] = ready & ticks.view_as(ready)
        return self._with_age(memory, held, entries, ticks, 1)

    def after_idle_steps(self, memory: Memory, n_steps: int) -> Memory:
        aged = {"age": memory["age"] + n_steps} if self.age_key else {}
        return memory | {"elapsed": (memory["elapsed"] + n_steps) % self.period} | aged

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

    def _with_age(
        self, memory: Memory, held: Entries, entries: Entries, sampled: Tensor, n_steps: int
    ) -> Change:
        """Add the age of the entries that are held to the outputs, if it has a key.

        Args:
            memory: memory with what is held now.
            held: outputs without the age.
            entries: entries that came in, with the age of those that are not held.
            sampled: rows that hold what came in, [M] bool; in the others the age grows.
            n_steps: by how many steps.
        """
        if not self.age_key:
            return memory, held
        new = as_rows(entries[self.age_key], self.rows)
        age = torch.where(expand_mask(sampled, new), new, memory["age"] + n_steps)
        return memory | {"age": age}, held | {self.age_key: from_rows(age, self.rows).clone()}
