"""The memory of a transform: buffers for M rows, their state in checkpoints, and the rows' random streams."""

import multiprocessing
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from damian.common import checks, counter_rng
from damian.common.tensors import expand_mask
from damian.transforms.entries import Memory
from damian.transforms.seeding import stream_name


class MemoryTransform(Transform):
    """Base class of transforms with buffers for M rows; see ``StatefulTransform``."""

    draws: bool = False
    """Whether the transform draws random numbers."""
    same_draws_for_all_agents: bool = False
    """Whether all agents of a world draw the same numbers."""
    one_level: bool = False
    """Whether its keys must name entries of one batch size, because each row has a part of all of them."""
    memory_setting: tuple[str, Any]
    """Key and value of the setting on which the size of the memory depends, for errors."""
    _rows: torch.Size | None = None
    _seed: int | None = None
    _world_seeds: Tensor | None = None
    _begun: tuple[TensorDictBase, Memory] | None = None
    """Outputs of the latest reset of all worlds, and the memory after it, which a step replaces."""

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

    @property
    def row_dims(self) -> dict[str, int]:
        """The dimension of a buffer, by name, in which its M rows lie, where that is not the first."""
        return {}

    @property
    def memory(self) -> Memory:
        """The memory of the transform: its buffers by name."""
        return cast(Memory, dict(self._buffers))

    def set_memory(self, memory: Memory) -> None:
        """Replace the buffers that have these names."""
        self._buffers.update(memory)

    def require_memory(self, rows: torch.Size, n_bytes: int) -> None:
        """Require that the memory of rows of this shape fits.

        Raises:
            InputError: it does not; the error names the setting that ``memory_setting`` tells.
        """
        there = " x ".join(map(str, rows))
        checks.fits(
            *self.memory_setting, n_bytes, f"take a smaller one, or fewer worlds and agents than {there}"
        )

    def clear_memory(self) -> None:
        """Delete the memory; the next reset counts as the first."""
        self._rows, self._begun = None, None
        self._buffers.clear()

    def _seeded_anew(self) -> None:
        """Delete the memory; a step needs no reset if none was taken since the latest reset of all worlds.

        For TorchRL's collectors reset an environment when they are made, and are seeded afterwards.
        """
        begun = self._begun
        stepped = begun is None or any(self._buffers.get(k) is not value for k, value in begun[1].items())
        self.clear_memory()
        self._begun = None if begun is None or stepped else (begun[0], {})

    def __setstate__(self, state: dict[str, Any]) -> None:
        """A copy has memory of its own: what was sent to a worker process would share the sender's."""
        super().__setstate__(state)
        self._buffers = {
            name: value.clone() if value is not None and value.is_shared() else value
            for name, value in self._buffers.items()
        }

    def clone(self) -> "MemoryTransform":
        """A copy of the transform without memory."""
        copied = super().clone()
        copied.clear_memory()
        return copied

    # Checkpoints.

    @property
    def memory_sizes(self) -> dict[str, int]:
        """Settings on which the shape and meaning of the memory depend, by name."""
        return {}

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
        saved = dict(zip(self.memory_sizes, numbers, strict=False))
        if saved != self.memory_sizes:
            raise RuntimeError(
                f"{type(self).__name__} has {_written(self.memory_sizes)}, but the loaded state is of one "
                f"with {_written(saved) or 'none'}: load it into a transform with the settings that it had"
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


def _unseeded() -> int:
    """A seed from torch's global generator; worker processes with the same state get different ones."""
    drawn = int(torch.randint(2**62, ()))
    return drawn ^ counter_rng.number_of(multiprocessing.current_process().name)


def _written(sizes: dict[str, int]) -> str:
    return ", ".join(f"{name}={value}" for name, value in sizes.items())
