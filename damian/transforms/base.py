"""The base class of transforms with memory: buffers, seeds, and the methods that subclasses implement."""

from collections.abc import Sequence
from typing import Any, NoReturn, cast

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.envs import Compose, EnvBase, Transform

from damian.common import counter_rng
from damian.common.tensors import expand_mask
from damian.transforms.entries import (
    Change,
    Entries,
    Memory,
    flag_rows,
    require_keys,
    row_shape,
    select_entries,
)
from damian.transforms.order import KeyUsage, check_order, leaf_transforms


class StatefulTransform(Transform):
    """Base class of transforms that remember earlier steps of each world, or of each agent of each world.

    The memory has M rows. For an entry under a nested key, such as ``("agents", "observation")``, there is a
    row for each element of the batch size of its innermost TensorDict; for an entry at the root, one for each
    world. The memory is allocated at the first reset and kept in buffers: ``state_dict`` saves it (by
    reference; clone the tensors before the next step, as some of them are written in place), ``to`` moves it,
    and worker processes receive it by pickling.

    A subclass implements pure functions of its memory and of entries: ``on_reset``, ``on_action`` (before the
    environment steps) and ``on_step`` (after it). Thus all transforms of an environment compile into one
    graph.

    Args:
        in_keys: keys of the entries that the transform reads, as in TorchRL's ``Transform``.
        out_keys: keys of the entries that it writes.
        in_keys_inv: keys of the actions that it reads.
        out_keys_inv: keys of the actions that it writes.
        seed: seed of everything that the transform draws. If not given, the seed is drawn from torch's global
            generator at the first reset.
    """

    action_keys: Sequence[NestedKey] = ()
    """Keys of the entries that are passed to ``on_action``, if they exist."""
    step_keys: Sequence[NestedKey] = ()
    """Keys of the entries that are passed to ``on_reset`` and ``on_step``, if they exist."""
    dropped_keys: Sequence[NestedKey] = ()
    """Keys of the entries that are removed from the outputs."""
    sent_key: NestedKey | None = None
    """Key of the flag that tells which rows send a message in this step; None if all do."""

    def __init__(
        self,
        in_keys: Sequence[NestedKey] = (),
        out_keys: Sequence[NestedKey] = (),
        in_keys_inv: Sequence[NestedKey] = (),
        out_keys_inv: Sequence[NestedKey] = (),
        seed: int | None = None,
    ) -> None:
        super().__init__(
            *([unravel_key(key) for key in keys] for keys in (in_keys, out_keys, in_keys_inv, out_keys_inv))
        )
        self._rows: torch.Size | None = None
        self._seed: int | None = seed
        self._world_seeds: Tensor | None = None

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

    def merge_worlds(self, before: Memory, after: Memory, stepped: Tensor) -> Memory:
        """The memory if only some worlds have stepped; the other worlds have sent no message.

        Args:
            before: memory before the step.
            after: memory after a step of all worlds.
            stepped: worlds that have stepped, [B] bool.
        """
        rows = self.expand_worlds(stepped)
        return {
            name: new if new is before[name] else torch.where(expand_mask(rows, new), new, before[name])
            for name, new in after.items()
        }

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
        return self.in_keys[0]

    @property
    def key_usage(self) -> KeyUsage:
        """What this transform does with which keys, for ``check_order``."""
        return KeyUsage()

    # TorchRL's hooks.

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        mask = None
        if self.has_memory:
            self._check_rows(tensordict_reset)
            mask = flag_rows(tensordict, "_reset", self.row_key, self.rows)
        else:
            require_keys(type(self).__name__, self.required_keys, tensordict_reset)
            self._rows = self.find_rows(tensordict_reset)
            self.set_memory(self.init_memory(tensordict_reset))
        if mask is None:
            device = next((value.device for value in self.memory.values()), None)
            mask = torch.ones(self.rows.numel(), dtype=torch.bool, device=device)
        change = self.on_reset(self.memory, select_entries(tensordict_reset, self.step_keys), mask)
        return self._write(
            tensordict_reset, change
        )  # TorchRL restores the entries of the worlds without a reset

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
        self.check()
        entries = select_entries(tensordict, self.action_keys)
        return self._write(tensordict, self.on_action(self.memory, entries))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.check()
        entries = select_entries(next_tensordict, self.step_keys)
        return self._write(next_tensordict, self.on_step(self.memory, entries))

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

    def expand_worlds(self, worlds: Tensor) -> Tensor:
        """Expand a mask of worlds [B] to a mask of rows [M]."""
        return worlds.view(-1, 1).expand(-1, self.rows.numel() // len(worlds)).reshape(-1)

    @property
    def memory(self) -> Memory:
        """The memory of the transform: its buffers by name."""
        return cast(Memory, dict(self._buffers))

    def set_memory(self, memory: Memory) -> None:
        """Replace the buffers that have these names."""
        self._buffers.update(memory)

    def clear_memory(self) -> None:
        """Delete the memory; the next reset counts as the first."""
        self._rows = None
        self._buffers.clear()

    def get_extra_state(self) -> Tensor | None:
        """The shape of the rows, for ``state_dict``."""
        return None if self._rows is None else torch.tensor(self._rows, dtype=torch.long)

    def set_extra_state(self, state: Tensor | None) -> None:
        """Set the shape of the rows from a ``state_dict``."""
        self._rows = None if state is None else torch.Size(state.tolist())

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        inner = {
            name.removeprefix(prefix): value for name, value in state_dict.items() if name.startswith(prefix)
        }
        saved = {k: v for k, v in inner.items() if "." not in k and k != "_extra_state"}
        devices = {name: buffer.device for name, buffer in self.memory.items()}
        # TorchRL also loads states without entries of this transform: the next reset is then the first.
        self.clear_memory()
        self.set_memory({k: v.detach().clone().to(devices.get(k, v.device)) for k, v in saved.items()})
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    def clone(self) -> "StatefulTransform":
        """A copy of the transform without memory."""
        copied = super().clone()
        copied.clear_memory()
        return copied

    # Seeds.

    def set_seed(self, seed: int | None) -> None:
        """Set the seed and delete the memory; the next reset counts as the first."""
        self._seed, self._world_seeds = seed, None
        self.clear_memory()

    def seed_worlds(self, seeds: Tensor) -> None:
        """Set a seed for each world, [B] integers: a world's draws then do not depend on the other worlds."""
        self._seed, self._world_seeds = None, seeds
        self.clear_memory()

    def streams(self, batch: torch.Size, device: torch.device) -> Tensor:
        """A random stream (a seed of the counter-based generator) for each row, [M] long.

        Args:
            batch: batch size of the worlds.
            device: device of the streams.
        """
        n_worlds = batch.numel()
        if self._world_seeds is not None:
            worlds = self._world_seeds.to(device)
        elif self._seed is not None:
            worlds = counter_rng.world_seeds(self._seed, n_worlds, device)
        else:
            worlds = torch.randint(2**32, (n_worlds,)).to(device)
        agents = torch.arange(self.rows.numel() // n_worlds, device=device)
        return counter_rng.bits(worlds.view(-1, 1), agents).flatten()

    # The place of the transform in an environment.

    def set_container(self, container: Any) -> None:
        super().set_container(container)
        while isinstance(container, Compose):
            check_order(leaf_transforms(container))
            outer = container.__dict__.get("_container")  # a weak reference
            container = outer() if outer is not None else None

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

    def check(self) -> None:
        """Make sure that the transform belongs to an environment that has been reset.

        Raises:
            RuntimeError: it does not.
        """
        if not self.has_memory or self.container is None:
            self._refuse()

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
