"""The base class of transforms with memory, the order in which they must stand, and how seeds reach them.

Importing this module extends ``TransformedEnv.set_seed`` for the whole process, in workers too: it then also
seeds the transforms of damian that the environment contains. All else stays as it is.
"""

import itertools
import multiprocessing
import warnings
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import wraps
from typing import Any, NamedTuple, NoReturn, cast

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import (
    Compose,
    ConditionalPolicySwitch,
    ConditionalSkip,
    EnvBase,
    FrameSkipTransform,
    MultiAction,
    NoopResetEnv,
    RandomTruncationTransform,
    RewardSum,
    StepCounter,
    TerminateTransform,
    Transform,
    TransformedEnv,
)

from damian.common import checks, counter_rng
from damian.common.errors import InputError
from damian.common.tensors import expand_mask
from damian.common.text_files import listed
from damian.keys import DONE, ENDS, STEPPED, last_part

Memory = dict[str, Tensor]
"""The memory of a transform: its buffers by name."""

Entries = dict[NestedKey, Tensor]
"""Entries of a TensorDict, by key."""

Change = tuple[Memory, Entries]
"""The new memory of a transform, and the entries that it writes."""


class Correction(NamedTuple):
    """How the entries that a transform has changed are corrected in stored steps (``BackupdateStorage``)."""

    correct: Callable[[Entries, TensorDictBase, Tensor], Entries]
    """Pure function of: the entries after the steps as they are known by now, by keys that begin with
    ``"next"``; the stored steps [T, B], the last of which is the latest one; and the number of earlier steps
    in the episode of each step, [T, B]. It returns the entries as the transform would have written them."""
    lookback: int = 0
    """Number of earlier steps on which the entries after a step depend."""
    paid: Callable[[TensorDictBase, Tensor], Tensor] | None = None
    """Only of late rewards: whether the reward of each step [T, B] has been paid by the last step."""
    delay_key: NestedKey | None = None
    """Only of late rewards: key of the delay of each reward [steps]."""


class KeyUsage(NamedTuple):
    """What a transform does with which keys; this decides which of two transforms must come first."""

    overwrites: Sequence[NestedKey] = ()
    """Entries that it writes whether they exist or not, and whatever their values are."""
    delays: Sequence[NestedKey] = ()
    """Entries whose values it delays or holds."""
    appends: Sequence[NestedKey] = ()
    """Entries to which it appends values that the actor knows without delay."""
    replaces: Sequence[NestedKey] = ()
    """Actions that it replaces before they reach the environment."""
    records: Sequence[NestedKey] = ()
    """Actions that it records as the policy chose them."""
    flushes_at_end: bool = False
    """Whether it delivers what is still in transit in the last step of an episode."""
    may_end: bool = False
    """Whether it may end episodes."""
    skips: bool = False
    """Whether it may keep worlds from stepping."""
    computes: Sequence[tuple[NestedKey, NestedKey]] = ()
    """Entries that it computes from others: pairs of the entry read and the one written."""
    age_of: Sequence[tuple[NestedKey, NestedKey]] = ()
    """Entries whose age it writes: pairs of the entry and the age."""
    held_entries: Sequence[tuple[NestedKey, NestedKey | None]] = ()
    """Entries that it holds: pairs of the entry and of the age that grows meanwhile, if there is one."""


class StatefulTransform(Transform):
    """Base class of transforms that remember earlier steps of each world, or of each agent of each world.

    The memory has M rows. For an entry under a nested key, such as ``("agents", "observation")``, there is a
    row for each element of the batch size of its innermost TensorDict; for an entry at the root, one for each
    world. The memory is allocated at the first reset and kept in buffers: ``state_dict`` saves it (by
    reference; clone the tensors before the next step, as some of them are written in place), ``to`` moves it,
    and worker processes receive it by pickling.

    A subclass implements pure functions of its memory and of entries: ``on_reset``, ``on_action`` (before the
    environment steps) and ``on_step`` (after it). TorchRL's hooks call them for one transform, and
    ``act``, ``observe`` and ``begin`` below for several at once, so that all transforms of an environment
    compile into one graph.

    ``set_seed`` of the environment seeds everything that the transform draws. Without it, and without
    ``seed``, the seed is drawn from torch's global generator at the first reset. What the transform writes
    shares no memory with its buffers, so that others may change it in place.

    Args:
        in_keys: keys of the entries that the transform reads, as in TorchRL's ``Transform``: one key (a name,
            or a tuple of names), or a list of keys.
        out_keys: keys of the entries that it writes.
        in_keys_inv: keys of the actions that it reads.
        out_keys_inv: keys of the actions that it writes.
        seed: seed of everything that the transform draws, until the environment is seeded.
        gradients: keep the autograd graph of the entries that the transform remembers. If false, what it
            writes has no gradient with respect to its inputs. The graph of a rollout grows from step to step;
            a reset of all worlds cuts it.
    """

    action_keys: Sequence[NestedKey] = ()
    """Keys of the entries that are passed to ``on_action``, if they exist."""
    step_keys: Sequence[NestedKey] = ()
    """Keys of the entries that are passed to ``on_reset`` and ``on_step``, if they exist."""
    dropped_keys: Sequence[NestedKey] = ()
    """Keys of the entries that are removed from the outputs."""
    sent_key: NestedKey | None = None
    """Key of the flag that says which rows send a message in this step; None if all do."""
    per_world: bool = False
    """Whether the memory has a row for each world, whatever entries ``in_keys`` name."""
    same_batch_size: bool = False
    """Whether all entries must have one batch size, because each row has a part of all of them."""
    omittable_outputs: Sequence[str] = ()
    """Names of those arguments whose key is that of an entry to create, or None to leave it out."""
    sees_merged_steps_only: bool = False
    """Whether the transform sees only the merged steps of ``SkipUntilReady``, as TorchRL's transforms do."""
    draws: bool = False
    """Whether the transform draws random numbers."""
    same_draws_for_all_agents: bool = False
    """Whether all agents of a world draw the same numbers."""
    _rows: torch.Size | None = None
    _seed: int | None = None
    _world_seeds: Tensor | None = None
    _begun: tuple[TensorDictBase, Memory] | None = None
    """Outputs of the latest reset of all worlds, and the memory after it, which a step replaces."""

    def __init__(
        self,
        in_keys: NestedKey | Sequence[NestedKey] = (),
        out_keys: NestedKey | Sequence[NestedKey] = (),
        in_keys_inv: NestedKey | Sequence[NestedKey] = (),
        out_keys_inv: NestedKey | Sequence[NestedKey] = (),
        seed: int | None = None,
        gradients: bool = False,
    ) -> None:
        super().__init__(*(read_keys(keys) for keys in (in_keys, out_keys, in_keys_inv, out_keys_inv)))
        if seed is not None:
            checks.seed(f"{type(self).__name__}: seed", seed)
        self._seed = seed
        self.gradients = gradients

    # Pure functions, for subclasses.

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        """Begin new episodes.

        Args:
            memory: memory before the reset.
            entries: outputs of the reset, as far as ``step_keys`` names them.
            mask: rows that are reset, [M] bool.

        Returns:
            The new memory, and the entries to write.
        """
        return memory, {}

    def on_action(self, memory: Memory, entries: Entries) -> Change:
        """Change entries on their way from the policy to the environment.

        Args:
            memory: memory before the step.
            entries: inputs of the step, as far as ``action_keys`` names them.

        Returns:
            The new memory, and the entries to write.
        """
        return memory, {}

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        """Change the outputs of a step.

        Args:
            memory: memory after ``on_action``.
            entries: outputs of the step, as far as ``step_keys`` names them.

        Returns:
            The new memory, and the entries to write.
        """
        return memory, {}

    def after_idle_steps(self, memory: Memory, n_steps: int) -> Memory:
        """The memory after steps in which no message arrived and no agent chose an action."""
        return memory

    def hindsight(self, keys: Collection[NestedKey]) -> Correction | None:
        """How stored entries are corrected where this transform has changed them.

        Args:
            keys: entries that are computed again from late messages, without ``"next"``, and the rewards.

        Returns:
            The correction, or None if the transform changes none of these entries.
        """
        return None

    def skipped_worlds(self, entries: Entries) -> Tensor | None:
        """Worlds that must step once more before the outputs are returned, [B] bool.

        Args:
            entries: outputs of the step.

        Returns:
            The mask, or None if the transform never skips steps.
        """
        return None

    def merge_steps(self, entries: Entries, later: Entries, stepped: Tensor) -> Entries:
        """Merge the outputs of several steps into those of one step.

        Args:
            entries: outputs before the latest step.
            later: outputs of the latest step.
            stepped: worlds that took the latest step, [B] bool.
        """
        raise NotImplementedError

    # What a transform is, for subclasses.

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        """Allocate the memory, given the outputs of the first reset."""
        return {}

    @property
    def required_keys(self) -> Sequence[NestedKey]:
        """Keys of the entries that the outputs of the first reset must have."""
        return self.in_keys

    @property
    def row_key(self) -> NestedKey:
        """Key of an entry whose innermost TensorDict has one element for each row."""
        return DONE if self.per_world else [*self.in_keys, *self.in_keys_inv][0]

    @property
    def row_dims(self) -> dict[str, int]:
        """The dimension of a buffer, by name, in which its M rows lie, where that is not the first."""
        return {}

    @property
    def memory_sizes(self) -> dict[str, int]:
        """Settings on which the shape and meaning of the memory depend, by name."""
        return {}

    @property
    def key_usage(self) -> KeyUsage:
        """What this transform does with which keys, for ``check_order``."""
        return KeyUsage()

    @property
    def created_keys(self) -> list[NestedKey]:
        """Keys of the entries that the transform adds to the outputs of the environment."""
        others = (getattr(self, name) for name in self.omittable_outputs)
        new = [key for key in self.out_keys if key not in [*self.in_keys, *self.key_usage.overwrites]]
        return new + [key for key in others if key is not None]

    # The memory.

    @property
    def has_memory(self) -> bool:
        """Has the memory been allocated, by a reset or by ``load_state_dict``."""
        return self._rows is not None

    @property
    def rows(self) -> torch.Size:
        """The shape of the rows, M in all."""
        assert self._rows is not None
        return self._rows

    def find_rows(self, tensordict: TensorDictBase) -> torch.Size:
        """The shape of the rows, given the outputs of the first reset."""
        path = path_of(self.row_key)
        inner = tensordict.get(path, None) if path else tensordict
        if inner is not None:
            return inner.batch_size
        # No entry of the group is in the outputs. The batch may be chosen at a reset (``batch_locked`` is
        # false, as in TorchRL's ``PendulumEnv``); the specs lack these leading dimensions then.
        kinds = (self.env.full_action_spec, self.env.full_reward_spec)
        inner_specs = next(specs[path] for specs in kinds if path in specs.keys(True))
        return torch.Size((*tensordict.batch_size, *inner_specs.shape[len(self.env.batch_size) :]))

    def as_rows_of_spec(self, value: Tensor, specs: Composite, key: NestedKey) -> Tensor:
        """A value in the shape of the spec under a key, for each of the M rows, [M, ...]."""
        inner = value.shape[len(spec_rows(specs, key)) :]
        return as_rows(value.expand((*self.rows, *inner)), self.rows).clone()

    @property
    def memory(self) -> Memory:
        """The memory of the transform: its buffers by name."""
        return cast(Memory, dict(self._buffers))

    def set_memory(self, memory: Memory) -> None:
        """Replace the buffers that have these names."""
        self._buffers.update(memory)

    def clear_memory(self) -> None:
        """Delete the memory; the next reset counts as the first."""
        self._rows, self._begun = None, None
        self._buffers.clear()

    def expand_worlds(self, worlds: Tensor) -> Tensor:
        """Expand a mask of worlds [B] to a mask of rows [M]."""
        return worlds.view(-1, 1).expand(-1, self.rows.numel() // len(worlds)).reshape(-1)

    def merge_worlds(self, before: Memory, after: Memory, stepped: Tensor) -> Memory:
        """The memory if only some worlds have stepped; the other worlds have sent no message.

        Args:
            before: memory before the step.
            after: memory after a step of all worlds.
            stepped: worlds that have stepped, [B] bool.
        """
        rows, merged = self.expand_worlds(stepped), {}
        for name, new in after.items():
            mask = rows.view(*[1] * self.row_dims.get(name, 0), *rows.shape)
            old = before[name]
            merged[name] = new if new is old else torch.where(expand_mask(mask, new), new, old)
        return merged

    def sending_rows(self, entries: Entries) -> Tensor | None:
        """The rows that send a message in this step, [M] bool; None if all do.

        Args:
            entries: inputs or outputs of the step.
        """
        sending = entries[self.sent_key].reshape(-1) if self.sent_key in entries else None
        if STEPPED not in entries:
            return sending
        stepped = self.expand_worlds(entries[STEPPED].reshape(-1))
        return stepped if sending is None else sending & stepped

    # TorchRL's hooks.

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        mask = None
        if self.has_memory:
            mask = reset_rows(tensordict, self.row_key, self.rows)
            rows = self.find_rows(tensordict_reset)
            if mask is None and not self.env.batch_locked and rows != self.rows:
                self.clear_memory()  # such an environment may begin with another number of worlds
            elif rows != self.rows:
                raise RuntimeError(
                    f"{type(self).__name__} has memory for rows of shape {tuple(self.rows)}, but there are "
                    f"now {tuple(rows)}: load a state that was saved with as many worlds and agents"
                )
        if not self.has_memory:
            self._init(tensordict_reset)
        outputs = tensordict_reset.detach() if mask is None else None
        # TorchRL restores the entries of the worlds without a reset.
        written = self._write(tensordict_reset, self._begin(tensordict_reset, mask))
        self._begun = None if outputs is None else (outputs, self.memory)
        return written

    def _init(self, outputs: TensorDictBase) -> None:
        """Allocate the memory, given the outputs of the first reset."""
        _check_orders(self.container)  # other transforms may have come since this one
        require_keys(type(self).__name__, self.required_keys, outputs)
        if self.in_keys_inv:
            require_keys(type(self).__name__, self.in_keys_inv, self.env.full_action_spec)
        self._rows = self.find_rows(outputs)
        if self.same_batch_size:
            for key in self.in_keys:
                shape, should = row_shape(outputs, key), "have other batch sizes: use one transform for each"
                checks.require(shape == self.rows, type(self).__name__, f"{self.row_key} and {key}", should)
        with torch.inference_mode(False):  # else the buffers could be written only in inference mode
            self.set_memory(self.init_memory(outputs))

    def _begin(self, outputs: TensorDictBase, mask: Tensor | None) -> Change:
        """Begin new episodes in the rows of the mask [M], or in all, given the outputs of the reset."""
        memory = self.memory
        if mask is None:
            device = next((value.device for value in memory.values()), None)
            mask = torch.ones(self.rows.numel(), dtype=torch.bool, device=device)
            memory = {name: value.detach() for name, value in memory.items()}
        return self.on_reset(memory, select_entries(outputs, self.step_keys, self.gradients), mask)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not self.action_keys:
            return tensordict
        self.check(tensordict.batch_size)
        entries = select_entries(tensordict, [*self.action_keys, STEPPED], self.gradients)
        change = self.on_action(self.memory, entries)
        if STEPPED in entries:
            change = self._only_stepped(change, entries[STEPPED], tensordict, tensordict)
        return self._write(tensordict, change)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.check(next_tensordict.batch_size)
        entries = select_entries(next_tensordict, self.step_keys, self.gradients)
        stepped = tensordict.get(STEPPED, None)
        if stepped is None:
            return self._write(next_tensordict, self.on_step(self.memory, entries))
        change = self.on_step(self.memory, entries | {STEPPED: stepped})
        return self._write(next_tensordict, self._only_stepped(change, stepped, tensordict, next_tensordict))

    def _only_stepped(
        self, change: Change, stepped: Tensor, before: TensorDictBase, after: TensorDictBase
    ) -> Change:
        """Undo a change in the worlds that do not step: these keep their memory and their entries.

        Args:
            change: as if all worlds had stepped.
            stepped: worlds that step, [B] bool.
            before: contains the entries from before the step.
            after: contains the entries that ``before`` lacks.
        """
        memory, entries = change
        stepped = stepped.reshape(-1)
        memory = self.merge_worlds(self.memory, memory, stepped)
        rows = self.expand_worlds(stepped)
        merged: Entries = {}
        for key, new in entries.items():
            # A later transform that widens an entry restores it itself.
            found = (td.get(key, None) for td in (before, after))
            same_shape = (value for value in found if value is not None and value.shape == new.shape)
            old = next(same_shape, torch.zeros_like(new))
            mask, shape = expand_mask(rows, as_rows(new, self.rows)), self.rows
            merged[key] = from_rows(torch.where(mask, as_rows(new, shape), as_rows(old, shape)), shape)
        return memory, merged

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._reset(tensordict, tensordict_reset)

    def _write(self, tensordict: TensorDictBase, change: Change) -> TensorDictBase:
        memory, entries = change
        self.set_memory(memory)
        for key, value in entries.items():
            tensordict.set(key, value)
        for key in self.dropped_keys:
            tensordict.pop(key, None)
        return tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        """The spec of the observations without ``dropped_keys``."""
        for key in self.dropped_keys:
            del observation_spec[key]
        return observation_spec

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """The specs with those of what the transform writes.

        Raises:
            InputError: it would write two entries under one name, or over an entry that there is already.
        """
        name, created = type(self).__name__, self.created_keys
        checks.distinct(f"{name}: names of the entries that it writes", created)
        present = {key for spec in output_spec.values() if spec is not None for key in spec.keys(True)}
        for key in created:
            require_new(name, key, present)
        return super().transform_output_spec(output_spec)

    def set_container(self, container: Any) -> None:
        super().set_container(container)
        if isinstance(container, Compose | TransformedEnv):
            _check_orders(container)  # again in ``_init``, as a Compose may not belong to an environment yet

    @property
    def env(self) -> EnvBase:
        """The environment with the transforms before this one.

        Raises:
            RuntimeError: the transform does not belong to an environment.
        """
        parent = self.parent
        if parent is None:
            self._refuse()
        return parent

    def check(self, batch_size: torch.Size | None = None) -> None:
        """Make sure that the transform belongs to an environment that has been reset.

        Args:
            batch_size: of the TensorDict of a step, if there is one.

        Raises:
            RuntimeError: it does not, or the TensorDict has other worlds than the memory.
        """
        if not self.has_memory and self._begun is not None:  # it was seeded after the reset
            (outputs, _), self._begun = self._begun, None
            self._init(outputs)
            self.set_memory(self._begin(outputs, None)[0])
        if not self.has_memory or self.container is None:
            self._refuse()
        if batch_size is not None and batch_size != self.rows[: len(batch_size)]:
            name, n_rows = type(self).__name__, tuple(self.rows)
            raise RuntimeError(
                f"{name} has memory for rows of shape {n_rows}, but this step has the batch size "
                f"{tuple(batch_size)}: every step needs all worlds that were reset; those that skip it "
                "have a false '_step', which an environment whose batch is chosen at reset does not support"
            )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._refuse()

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._refuse()

    def _refuse(self) -> NoReturn:
        name = type(self).__name__
        raise RuntimeError(
            f"{name} remembers earlier steps, so it works only in an environment, after a reset: "
            f"TransformedEnv(env, {name}(...)); for stored steps, call damian.delay_trajectories(data, ...)"
        )

    # Copies and checkpoints.

    def __setstate__(self, state: dict[str, Any]) -> None:
        """A copy has memory of its own: what was sent to a worker process would share the sender's."""
        super().__setstate__(state)
        self._buffers = {
            name: value.clone() if value is not None and value.is_shared() else value
            for name, value in self._buffers.items()
        }

    def clone(self) -> "StatefulTransform":
        """A copy of the transform without memory."""
        copied = super().clone()
        copied.clear_memory()
        return copied

    def get_extra_state(self) -> Tensor | None:
        """``memory_sizes`` and the shape of the rows, for ``state_dict``."""
        if self._rows is None:
            return None
        return torch.tensor([*self.memory_sizes.values(), *self._rows], dtype=torch.long)

    def set_extra_state(self, state: Tensor | None) -> None:
        """Set the shape of the rows from a ``state_dict``.

        Raises:
            RuntimeError: the state is that of a transform with other settings.
        """
        if state is None:
            self._rows = None
            return
        n_sizes, numbers = len(self.memory_sizes), state.tolist()
        if numbers[:n_sizes] != [*self.memory_sizes.values()]:
            raise RuntimeError(
                f"{type(self).__name__} has {self.memory_sizes}, but the loaded state is of one with "
                f"{numbers[:n_sizes]}: load it into a transform with the settings that it had"
            )
        self._rows = torch.Size(numbers[n_sizes:])

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        if prefix + "_extra_state" in state_dict:  # refuse a foreign state before the memory is replaced
            self.set_extra_state(state_dict[prefix + "_extra_state"])
        inner = {
            name.removeprefix(prefix): value for name, value in state_dict.items() if name.startswith(prefix)
        }
        saved = {k: v for k, v in inner.items() if "." not in k and k != "_extra_state"}
        devices = {name: buffer.device for name, buffer in self.memory.items()}
        # TorchRL also loads states without entries of this transform: the next reset is then the first.
        self.clear_memory()
        self.set_memory({k: v.detach().clone().to(devices.get(k, v.device)) for k, v in saved.items()})
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    # Random streams.

    def set_seed(self, seed: int | None) -> None:
        """Set the seed and delete the memory; the next reset counts as the first.

        If all worlds have just been reset, they need not be reset again. ``set_seed`` of the environment
        calls this method. Transforms of one environment draw different numbers from the same seed.
        """
        self._seed, self._world_seeds = seed, None
        self._seeded_anew()

    def seed_worlds(self, seeds: Tensor) -> None:
        """Set a seed for each world, [B] integers: a world's draws then do not depend on the other worlds."""
        self._seed, self._world_seeds = None, seeds.to(torch.long)
        self._seeded_anew()

    def _seeded_anew(self) -> None:
        """Delete the memory; a step needs no reset if none was taken since the latest reset of all worlds.

        For TorchRL's collectors reset an environment when they are made, and are seeded afterwards.
        """
        begun = self._begun
        stepped = begun is None or any(self._buffers.get(k) is not value for k, value in begun[1].items())
        self.clear_memory()
        self._begun = None if begun is None or stepped else (begun[0], {})

    def streams(self, batch: torch.Size, device: torch.device) -> Tensor:
        """A random stream (a key of the counter-based generator) for each row, [M] int64.

        Args:
            batch: batch size of the worlds.
            device: device of the streams.
        """
        n_worlds = batch.numel()
        n_agents = self.rows.numel() // n_worlds
        if not self.draws:
            return torch.zeros(self.rows.numel(), dtype=torch.long, device=device)
        if self._world_seeds is not None:
            worlds = self._world_seeds.to(device)
        else:
            seed = _unseeded() if self._seed is None else self._seed
            worlds = counter_rng.world_seeds(seed, n_worlds, device)
        name = torch.tensor(counter_rng.number_of(stream_name(self)), device=device)
        agents = torch.arange(n_agents, device=device)
        agents = torch.zeros_like(agents) if self.same_draws_for_all_agents else agents
        return counter_rng.bits64(worlds.view(-1, 1), name, agents).flatten()


# A step of several transforms; pure functions. ``DelayedEnv`` compiles them with the worlds.


def act(
    transforms: Sequence[StatefulTransform], memories: Sequence[Memory], entries: Entries
) -> tuple[list[Memory], Entries]:
    """Pass the inputs of a step through the transforms, from the last to the first.

    Args:
        transforms: in the order in which they process outputs.
        memories: of each of them.
        entries: inputs of the step.

    Returns:
        The new memories, and the inputs as the environment gets them.
    """
    changed_memories = list(memories)
    for i, transform in reversed(list(enumerate(transforms))):
        changed_memories[i], changed = transform.on_action(changed_memories[i], entries)
        entries = entries | changed
    return changed_memories, entries


def observe(
    transforms: Sequence[StatefulTransform],
    memories: Sequence[Memory],
    outputs: Entries,
    extra: Entries | None = None,
) -> tuple[list[Memory], Entries]:
    """Pass the outputs of a step through the transforms.

    Args:
        transforms: in the order in which they process outputs.
        memories: of each of them, after ``act``.
        outputs: of the environment.
        extra: entries that the transforms read, but that are no outputs.
    """
    changed_memories = list(memories)
    for i, transform in enumerate(transforms):
        changed_memories[i], changed = transform.on_step(changed_memories[i], outputs | (extra or {}))
        outputs = drop_keys(outputs | changed, transform.dropped_keys)
    return changed_memories, outputs


def begin(
    transforms: Sequence[StatefulTransform], memories: Sequence[Memory], outputs: Entries, mask: Tensor
) -> tuple[list[Memory], Entries]:
    """Begin new episodes in the worlds of the mask [B] bool, given the outputs of the reset."""
    changed_memories = list(memories)
    for i, transform in enumerate(transforms):
        rows = transform.expand_worlds(mask)
        changed_memories[i], changed = transform.on_reset(changed_memories[i], outputs, rows)
        outputs = drop_keys(outputs | changed, transform.dropped_keys)
    return changed_memories, outputs


# The order of transforms.


def check_order(transforms: Sequence[Transform]) -> None:
    """Refuse an order in which one transform undoes or misses the effect of another.

    Pairs of which neither is damian's are not looked at. What TorchRL's own transforms do is read from their
    keys. Where a wrong order may be meant, a warning is given.

    Args:
        transforms: transforms in the order in which they process the environment's outputs.

    Raises:
        InputError: two transforms are in the wrong order; the message names them and the key.
    """
    usages = [(transform, _usage_of(transform)) for transform in transforms]
    for (first, a), (second, b) in itertools.combinations(usages, 2):
        if isinstance(first, StatefulTransform) or isinstance(second, StatefulTransform):
            _check_pair(first, a, second, b)


def _check_orders(container: Any) -> None:
    """Refuse a wrong order in a Compose, or in an environment and those within it.

    Raises:
        InputError: as ``check_order``; or a transform of the same environment steps a copy of damian's.
    """
    own = leaf_transforms(container if isinstance(container, Compose) else container.transform)
    check_order(own if isinstance(container, Compose) else all_transforms(container))
    first = next((each for each in own if isinstance(each, StatefulTransform)), None)
    for each in own[own.index(first) :] if first is not None else []:
        if isinstance(each, _STEPPING):
            name = type(each).__name__
            why = f"{name} steps a copy of what comes before it, which has no memory; or put it around: "
            around = f"TransformedEnv(env, {name}(...), auto_unwrap=False)"
            raise _wrong_order((type(first).__name__, name), why + around)


_STEPPING = (FrameSkipTransform, NoopResetEnv, MultiAction, ConditionalPolicySwitch)
"""TorchRL's transforms that step a copy of what comes before them in their environment."""


def _check_pair(first: Transform, a: KeyUsage, second: Transform, b: KeyUsage) -> None:
    names = type(first).__name__, type(second).__name__
    used = [*first.in_keys, *a.delays, *a.appends] if isinstance(first, StatefulTransform) else []
    for key in _common_keys(used, b.overwrites):
        raise _wrong_order(names, f"it uses {key}, which {names[1]} creates")
    for key in _common_keys(a.records, b.replaces):
        why = f"it must record {key} as chosen, and actions pass the transforms in reverse order"
        raise _wrong_order(names, why)
    for key in _common_keys(a.appends, b.delays):
        raise _wrong_order(names, f"{names[1]} must not delay what it appends to {key}")
    if a.flushes_at_end and b.may_end:
        raise _wrong_order(names, f"what is in transit when {names[1]} ends an episode would be lost")
    if a.skips:
        raise _wrong_order(names, f"{names[1]} must know which worlds skip a step")
    for key, computed in a.computes:
        if key in b.delays and key in second.out_keys and computed not in b.delays:
            problem = f"{names[0]} computes {computed} from {key} before {names[1]} changes {key}"
            warnings.warn(f"order of transforms: {problem}", stacklevel=2)
    for (key, age), (held, grown) in itertools.product(a.age_of, b.held_entries):
        if key == held and age != grown:
            problem = f"{names[1]} holds {key}, whose age {names[0]} writes under {age}"
            remedy = f"give {names[1]} age_key={age!r}, so that the age grows with what is held"
            warnings.warn(f"order of transforms: {problem}: {remedy}", stacklevel=2)


def _usage_of(transform: Transform) -> KeyUsage:
    if isinstance(transform, StatefulTransform):
        return transform.key_usage
    ends = isinstance(transform, StepCounter) and transform.max_steps is not None
    ends = ends or isinstance(transform, (RandomTruncationTransform, TerminateTransform))
    # Not the properties: some of TorchRL's transforms choose their keys when these are first read.
    read, written = (transform.__dict__.get(name) or [] for name in ("_in_keys", "_out_keys"))
    if isinstance(transform, RewardSum) and not read:
        read, written = ["reward"], ["episode_reward"]
    others = [key for key in written if key not in read]
    return KeyUsage(
        may_end=ends or any(last_part(key) in ENDS for key in others),
        skips=isinstance(transform, ConditionalSkip),
        computes=[(key, other) for key in read for other in others],
    )


def _wrong_order(names: tuple[str, str], why: str) -> InputError:
    return InputError(f"order of transforms: {names[0]} must come after {names[1]}, because {why}")


def _common_keys(some: Sequence[NestedKey], others: Sequence[NestedKey]) -> list[NestedKey]:
    return [key for key in some if key in others]


def leaf_transforms(transform: Transform | None) -> list[Any]:
    """All transforms of a Compose and of the Composes within it, in order; or the one transform."""
    if transform is None:
        return []
    if not isinstance(transform, Compose):
        return [transform]
    return [leaf for inner in transform for leaf in leaf_transforms(inner)]


def all_transforms(env: EnvBase | None) -> list[Transform]:
    """All transforms of an environment and of those within it, in the order in which outputs pass them."""
    if not isinstance(env, TransformedEnv):
        return []
    return [*all_transforms(env.base_env), *leaf_transforms(env.transform)]


# Seeds, which TorchRL's ``TransformedEnv`` does not pass on to its transforms.


def stream_name(transform: Transform) -> str:
    """The name that keeps the random streams of a transform apart from all others in its environment.

    It is made of the transform's class and keys and, if several have both in common, of its place among them,
    so that adding another transform changes no draws.
    """
    name = _class_and_keys(transform)
    others = all_transforms(transform.container)
    alike = [other for other in others if type(other) is type(transform) and _class_and_keys(other) == name]
    return f"{name} {next((i for i, other in enumerate(alike) if other is transform), 0)}"


def _class_and_keys(transform: Transform) -> str:
    return f"{type(transform).__name__} {transform.in_keys} {transform.in_keys_inv}"


def _unseeded() -> int:
    """A seed from torch's global generator; worker processes with the same state get different ones."""
    drawn = int(torch.randint(2**62, ()))
    return drawn ^ counter_rng.number_of(multiprocessing.current_process().name)


_set_seed_of_torchrl = TransformedEnv.set_seed


@wraps(_set_seed_of_torchrl)
def _set_seed(self: TransformedEnv, seed: int | None = None, static_seed: bool = False) -> int | None:
    for transform in leaf_transforms(self.transform):
        if isinstance(transform, StatefulTransform):
            transform.set_seed(seed)
    return _set_seed_of_torchrl(self, seed, static_seed)


TransformedEnv.set_seed = _set_seed  # type: ignore[method-assign]


# Entries of TensorDicts, viewed as M rows: one for each world, or for each agent of each world.


def read_keys(written: NestedKey | Sequence[NestedKey]) -> list[NestedKey]:
    """Keys as TorchRL's transforms take them: a name or a tuple of names is one key, a list holds several.

    Raises:
        InputError: something is no key.
    """
    keys = [written] if isinstance(written, str) or _is_nested(written) else written
    no_key = "is not a key such as 'observation' or ('agents', 'observation'), nor a list of keys"
    checks.require(isinstance(keys, Iterable), "keys", repr(written), no_key)
    found: list[NestedKey] = list(cast(Iterable[NestedKey], keys))
    for key in found:
        checks.require(bool(key) and (isinstance(key, str) or _is_nested(key)), "keys", repr(key), no_key)
    return [unravel_key(key) for key in found]


def _is_nested(key: object) -> bool:
    """Is this a tuple of names, at any depth, as ``unravel_key`` takes it?"""
    return isinstance(key, tuple) and bool(key) and all(isinstance(k, str) or _is_nested(k) for k in key)


def path_of(key: NestedKey) -> tuple[str, ...]:
    """The path of the TensorDict that directly contains an entry."""
    return cast(tuple[str, ...], key[:-1]) if isinstance(key, tuple) else ()


def row_shape(tensordict: TensorDictBase, key: NestedKey) -> torch.Size:
    """The batch size of the TensorDict that directly contains an entry."""
    path = path_of(key)
    return (tensordict.get(path) if path else tensordict).batch_size


def spec_rows(specs: Composite, key: NestedKey) -> torch.Size:
    """As ``row_shape``, but read from specs."""
    path = path_of(key)
    return (specs[path] if path else specs).shape


def as_rows(value: Tensor, rows: torch.Size) -> Tensor:
    """Reshape an entry [*rows, ...] to [M, ...], where M is the number of rows."""
    return value.reshape(rows.numel(), *value.shape[len(rows) :])


def from_rows(value: Tensor, rows: torch.Size) -> Tensor:
    """Reshape [M, ...] to an entry [*rows, ...]."""
    return value.view((*rows, *value.shape[1:]))


def select_entries(tensordict: TensorDictBase, keys: Sequence[NestedKey], gradients: bool = False) -> Entries:
    """The entries with these keys, as far as they exist, without their autograd graph unless it is wanted."""
    found = {}
    for key in keys:
        value = tensordict.get(key, None)
        if value is not None:
            found[key] = value.detach() if value.requires_grad and not gradients else value
    return found


def drop_keys(entries: Entries, keys: Sequence[NestedKey]) -> Entries:
    """The entries without those of these keys."""
    return {key: value for key, value in entries.items() if key not in keys}


def sibling_key(key: NestedKey, name: NestedKey | None) -> NestedKey | None:
    """The key of an entry in the same TensorDict as another entry.

    Args:
        key: key of the other entry, such as ``("agents", "observation")``.
        name: bare name, such as ``age``, which gives ``("agents", "age")``. A nested key, or None, is
            returned as it is.
    """
    if name is None or not isinstance(name, str) or isinstance(key, str):
        return name
    return (*key[:-1], name)


def existing(keys: Iterable[NestedKey | None]) -> list[NestedKey]:
    """The keys that are not None."""
    return [key for key in keys if key is not None]


def require_keys(transform: str, keys: Sequence[NestedKey], present: TensorDictBase | Composite) -> None:
    """Require that the entries that a transform reads exist.

    Args:
        transform: name of the transform, for errors.
        keys: of the entries.
        present: the outputs of a reset, or specs.

    Raises:
        InputError: one is missing.
    """
    known = list(present.keys(True, True))
    for key in keys:
        should = f"is not among the keys of the environment: {listed(map(str, known))}"
        if isinstance(key, tuple) and all(part in known for part in key):
            should = f"is one nested key, which the environment lacks; two keys are written {list(key)}"
        checks.require(key in known, transform, key, should)


def require_new(transform: str, key: NestedKey, present: Iterable[NestedKey]) -> None:
    """Require that an entry that a transform creates would not replace another one.

    Raises:
        InputError: there is such an entry already.
    """
    should = "is already an entry of the environment: choose another name (None leaves an optional entry out)"
    checks.require(unravel_key(key) not in present, transform, key, should)


def flag_keys(name: str, key: NestedKey, present: Iterable[NestedKey]) -> list[NestedKey]:
    """The keys of the flags that apply to an entry, such as ``done``, the outermost first.

    These are the flags in the TensorDict of the entry and in those that contain it. If there are none, they
    are all flags within the innermost TensorDict around the entry that contains any: a world is done, or is
    reset, if any of its agents is, as TorchRL aggregates flags.

    Args:
        name: name of the flag.
        key: key of the entry.
        present: all keys that exist.
    """
    path = path_of(key)
    flags = [flag for flag in present if last_part(flag) == name]
    around = [flag for flag in flags if path[: len(path_of(flag))] == path_of(flag)]
    if around:
        return sorted(around, key=lambda flag: len(path_of(flag)))
    within = ([f for f in flags if path_of(f)[:depth] == path[:depth]] for depth in range(len(path), -1, -1))
    return next((found for found in within if found), [])


def reset_rows(tensordict: TensorDictBase, key: NestedKey, rows: torch.Size) -> Tensor | None:
    """The rows of an entry that are reset, [M] bool, or None if the TensorDict does not say which.

    If there are flags ``_reset`` at several levels, the outermost one decides, as in TorchRL.
    """
    keys = flag_keys("_reset", key, list(tensordict.keys(True, True)))
    if not keys:
        return None
    around = path_of(key)[: len(path_of(keys[0]))] == path_of(keys[0])
    return any_flag([tensordict.get(flag) for flag in (keys[:1] if around else keys)], rows)


def any_flag(flags: Sequence[Tensor], rows: torch.Size) -> Tensor:
    """Whether any of some flags of worlds [*B, 1], or of their agents [*B, N, 1], is true for a row, [M]."""
    found = torch.zeros(rows, dtype=torch.bool, device=flags[0].device)
    for flag in flags:
        shape = flag.shape[:-1]
        if len(shape) > len(rows):
            found = found | flag.flatten(len(rows)).any(-1)
        else:
            found = found | expand_mask(flag.squeeze(-1), found)
    return found.reshape(-1)
