"""The base class of transforms with memory: the methods that subclasses implement, and TorchRL's hooks."""

from collections.abc import Sequence
from typing import Any, NoReturn

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import Compose, EnvBase, TransformedEnv

from damian.common import checks
from damian.common.tensors import expand_mask
from damian.keys import DONE, STEPPED, last_part
from damian.transforms.batches import require_one_level
from damian.transforms.entries import (
    Change,
    Entries,
    Memory,
    as_rows,
    from_rows,
    read_keys,
    require_keys,
    require_new,
    reset_rows,
    row_shape,
    select_entries,
)
from damian.transforms.memory import MemoryTransform
from damian.transforms.order import KeyUsage, check_order, check_stepping, leaf_transforms
from damian.transforms.seeding import all_transforms


class StatefulTransform(MemoryTransform):
    """Base class of transforms that remember earlier steps of each world, or of each agent of each world.

    The memory has M rows. For an entry under a nested key, such as ``("agents", "observation")``, there is a
    row for each element of the batch size of its innermost TensorDict; for an entry at the root, one for each
    world. The memory is allocated at the first reset and kept in buffers: ``state_dict`` saves it (by
    reference; clone the tensors before the next step, as some of them are written in place), ``to`` moves it,
    and worker processes receive it by pickling.

    A subclass implements pure functions of its memory and of entries: ``on_reset``, ``on_action`` (before the
    environment steps) and ``on_step`` (after it). Thus all transforms of an environment compile into one
    graph.

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
    """Key of the flag that tells which rows send a message in this step; None if all do."""
    per_world: bool = False
    """Whether the memory has a row for each world, and not for each element that ``in_keys`` tell of."""
    optional_keys: Sequence[str] = ()
    """Names of those arguments whose key is that of an entry to create, or None to leave it out."""
    after_skipping: bool = False
    """Whether the transform sees only the merged steps of ``SkipUntilReady``, as TorchRL's transforms do."""

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
        self.memory_setting = type(self).__name__, "its memory"

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

    # Called at the first reset, for subclasses.

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        """Allocate the memory, given the outputs of the first reset."""
        return {}

    def memory_bytes(self, tensordict: TensorDictBase, n_rows: int) -> int:
        """Size of the memory for so many rows, if it grows with a setting [bytes].

        Args:
            tensordict: outputs of the first reset.
            n_rows: number of rows, M.
        """
        return 0

    def find_rows(self, tensordict: TensorDictBase) -> torch.Size:
        """The shape of the rows, given the outputs of the first reset."""
        return row_shape(tensordict, self.row_key)

    @property
    def required_keys(self) -> Sequence[NestedKey]:
        """Keys of the entries that the outputs of the first reset must have."""
        return self.in_keys

    @property
    def row_key(self) -> NestedKey:
        """Key of an entry whose innermost TensorDict has one element for each row."""
        return DONE if self.per_world else self.in_keys[0]

    @property
    def key_usage(self) -> KeyUsage:
        """What this transform does with which keys, for ``check_order``."""
        return KeyUsage()

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
            if mask is None and not self.env.batch_locked and self.find_rows(tensordict_reset) != self.rows:
                self.clear_memory()  # such an environment may begin with another number of worlds
        if self.has_memory:
            self._check_rows(tensordict_reset)
        else:
            self._init(tensordict_reset)
        outputs = tensordict_reset.detach() if mask is None else None
        # TorchRL restores the entries of the worlds without a reset.
        written = self._write(tensordict_reset, self._begin(tensordict_reset, mask))
        self._begun = None if outputs is None else (outputs, self.memory)
        return written

    def _init(self, outputs: TensorDictBase) -> None:
        """Allocate the memory, given the outputs of the first reset."""
        self._check_order(self.container)  # others may have come since this one
        require_keys(type(self).__name__, self.required_keys, outputs)
        if self.one_level:
            require_one_level(type(self).__name__, [*self.in_keys, *self.in_keys_inv], outputs, self.env)
        rows = self.find_rows(outputs)
        self.require_memory(rows, self.memory_bytes(outputs, rows.numel()))
        self._rows = rows
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

    def _check_rows(self, tensordict: TensorDictBase) -> None:
        rows = self.find_rows(tensordict)
        if rows != self.rows:
            raise RuntimeError(
                f"{type(self).__name__} has memory for rows of shape {tuple(self.rows)}, but the environment "
                f"has {tuple(rows)}: load a state that was saved with the same number of worlds and agents"
            )

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

    # The place of the transform in an environment.

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
        name, created = type(self).__name__, self.key_usage.creates
        checks.distinct(f"{name}: names of the entries that it writes", created)
        present = {key for spec in output_spec.values() if spec is not None for key in spec.keys(True)}
        for key in created:
            require_new(name, key, present, self._other_name(key))
        return super().transform_output_spec(output_spec)

    def _other_name(self, key: NestedKey) -> str:
        """How to name an entry of ``optional_keys`` in another way, as the end of an error."""
        argument = next((name for name in self.optional_keys if getattr(self, name) == key), None)
        old, new = (last_part(one) for one in (self.row_key, key))
        return f", such as {argument}='{old}_{new}', or None to leave it out" if argument else ""

    def set_container(self, container: Any) -> None:
        super().set_container(container)
        while isinstance(container, Compose):
            check_order(leaf_transforms(container))
            check_stepping(leaf_transforms(container))
            outer = container.__dict__.get("_container")  # a weak reference
            container = outer() if outer is not None else None
        self._check_order(container)

    @staticmethod
    def _check_order(env: EnvBase | None) -> None:
        """Refuse a wrong order of the transforms of an environment and of those within it."""
        check_order(all_transforms(env))
        if isinstance(env, TransformedEnv):
            check_stepping(leaf_transforms(env.transform))

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
