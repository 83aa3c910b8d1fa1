"""Transforms for clocks that are slower than the environment's (paper, section 3.6), and skipped steps."""

from collections.abc import Collection, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded

from damian import keys
from damian.common import checks, counter_rng
from damian.common.tensors import expand_mask
from damian.delays.laws import Delay, in_steps
from damian.keys import next_key
from damian.transforms.base import (
    Change,
    Correction,
    Entries,
    KeyUsage,
    Memory,
    StatefulTransform,
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
            first reset also: the entries have different batch sizes.

    Examples:
        >>> clock = SampleAndHold(4, ["observation"], ["action"])
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), clock)  # the agent acts in every fourth step
    """

    same_batch_size = True

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
        self.step_keys = existing([*self.in_keys, ready_key, self.age_key])

    @property
    def key_usage(self) -> KeyUsage:
        delayed = existing([*self.in_keys, self.age_key])
        held = [(key, self.age_key) for key in self.in_keys if self.period > 1]
        return KeyUsage(delays=delayed, replaces=self.in_keys_inv, held_entries=held)

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
        memory = {"elapsed": elapsed}  # steps since the latest tick
        memory |= {f"held_{i}": as_rows(value, self.rows) for i, value in enumerate(first.values())}
        specs = self.env.full_action_spec
        for i, key in enumerate(self.in_keys_inv):
            memory[f"action_at_tick_{i}"] = self.as_rows_of_spec(specs[key].zero(), specs, key)
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
        return self._hold(memory, entries, self.in_keys_inv, "action_at_tick", memory["elapsed"] == 0)

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

    def hindsight(self, keys: Collection[NestedKey]) -> Correction | None:
        """Keeps entries, between two ticks, as they are known by now for the latest tick.

        Raises:
            InputError: the clocks are staggered, so that no stored step says when they ticked.
        """
        held = [key for key in self.in_keys if key in keys]
        if not held or self.period == 1:
            return None
        should = "has ticks that no stored step shows: back-updating needs a clock without stagger"
        checks.require(not self.stagger, "SampleAndHold: stagger", self.stagger, should)

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
    """Steps each world until some agent can choose an action again, or the episode ends.

    The outputs equal, bit for bit, those of stepping the environment until then with actions that no agent
    executes. Only the reward is the sum of gamma^k r_k over the merged steps k = 0, 1, ..., and ``duration``,
    [B, 1] long, is the number of these steps (0 after a reset). A learner that discounts the next state value
    by gamma^duration learns in a semi-Markov decision process (Sutton, Precup and Singh, 1999).

    The transform works only in a ``DelayedEnv`` on a ``UavEnv``, where worlds with a ready agent can pause,
    with all of their messages in transit, while the others step on. Its place among damian's own transforms
    does not matter, but these must come before all others. Transforms of TorchRL that come later process only
    the merged steps: ``StepCounter`` counts decisions.

    Args:
        gamma: discount per merged step, in [0, 1]; with 1, returns are those of the single steps.
        reward_keys: keys of the rewards to sum.

    Raises:
        InputError: gamma is not in [0, 1].

    Examples:
        >>> clock = ClockConfig(skip=True)  # adds the transform
        >>> env = make_env(ScenarioConfig(motion=MotionConfig("polynomial"), clock=clock))
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
        """Worlds in which no agent is ready and the episode goes on, [B] bool."""
        ready, done = entries[keys.READY], entries[keys.DONE]
        return ~(ready.flatten(1).any(-1) | done.view(-1))

    def merge_steps(self, entries: Entries, later: Entries, stepped: Tensor) -> Entries:
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
        shape, device = torch.Size((*observation_spec.shape, 1)), observation_spec.device
        observation_spec[keys.DURATION] = Unbounded(shape, dtype=torch.long, device=device)
        return observation_spec
