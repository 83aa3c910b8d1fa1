"""What the transforms share: state that lives in buffers from step to step, seeds, and their order."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple, NoReturn

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor, nn
from torchrl.envs import Compose, Transform

from damian.errors import InputError
from damian.world import draws


class Lazy(nn.Module):
    """A module whose buffers begin as None, and take the shapes of what they first hold or load."""

    def forget(self) -> None:
        """Begin again: the next reset is the first."""
        for module in self.modules():
            if isinstance(module, Lazy):
                module._buffers.update(dict.fromkeys(module._buffers))

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        for name, buffer in self._buffers.items():
            saved = state_dict.get(f"{prefix}{name}")
            if saved is not None:
                device = saved.device if buffer is None else buffer.device
                self._buffers[name] = saved.detach().clone().to(device)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


class Order(NamedTuple):
    """What a transform does with keys: decides which of two must come first."""

    reads: Sequence[NestedKey] = ()
    """Read from what the environment shows."""
    makes: Sequence[NestedKey] = ()
    """Written anew, whatever was there."""
    holds: Sequence[NestedKey] = ()
    """Held back for some time."""
    appends: Sequence[NestedKey] = ()
    """Made longer by what the actor knows by itself."""
    replaces: Sequence[NestedKey] = ()
    """Actions that the environment gets in place of the chosen ones."""
    records: Sequence[NestedKey] = ()
    """Actions that are remembered as they were chosen."""


class Stateful(Transform, Lazy):
    """A transform with a memory: one row for each world, or for each agent of each world.

    An entry under a nested key, such as ``("agents", "observation")``, has a row for each element of the
    batch size of its innermost TensorDict; an entry at the root has one for each world. The memory is made
    at the first reset, and kept in buffers: it is saved with ``state_dict``, moves with ``to``, and travels
    into worker processes.

    Args:
        seed: of everything that is drawn; without one, drawn from torch's global generator at the first
            reset.
    """

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
        self._seed: int | None = seed
        self._world_seeds: Tensor | None = None

    # Seeds.

    def set_seed(self, seed: int | None) -> None:
        """Draw everything anew from the next reset on, which is the first."""
        self._seed, self._world_seeds = seed, None
        self.forget()

    def seed_worlds(self, seeds: Tensor) -> None:
        """Give every world its own stream, [B] integers: it draws alone what it draws among others."""
        self._seed, self._world_seeds = None, seeds
        self.forget()

    def _streams(self, batch: torch.Size, rows: torch.Size, device: torch.device) -> Tensor:
        """A random stream for each row, [M]."""
        n_worlds = batch.numel()
        if self._world_seeds is not None:
            worlds = self._world_seeds.to(device)
        elif self._seed is not None:
            worlds = draws.world_seeds(self._seed, n_worlds, device)
        else:
            worlds = torch.randint(2**32, (n_worlds,)).to(device)
        each = torch.arange(rows.numel() // n_worlds, device=device)
        return draws.bits(worlds.view(-1, 1), each).flatten()

    # The order of a chain.

    @property
    def order(self) -> Order:
        """What this transform does with which keys."""
        return Order()

    def set_container(self, container: Any) -> None:
        super().set_container(container)
        while isinstance(container, Compose):
            check_order(_leaves(container))
            above = container.__dict__.get("_container")
            container = above() if above is not None else None

    def clone(self) -> "Stateful":
        """The same transform, with a memory of its own that is still empty."""
        copied = super().clone()
        for name, module in list(copied._modules.items()):
            if isinstance(module, Lazy):
                twin = module.__class__.__new__(module.__class__)
                twin.__dict__.update(module.__dict__)
                twin._buffers = dict(module._buffers)
                copied._modules[name] = twin
        copied.forget()
        return copied

    # Outside an environment there are no steps.

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._refuse()

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._refuse()

    def _refuse(self) -> NoReturn:
        name = type(self).__name__
        raise RuntimeError(
            f"{name} remembers earlier steps, so it works only on an environment that is reset and "
            f"stepped: TransformedEnv(env, {name}(...))"
        )

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._reset(tensordict, tensordict_reset)


def check_order(chain: Sequence[Transform]) -> None:
    """Refuse an order in which a transform undoes or misses another's work.

    Raises:
        InputError: names the two, the key, and which must come first.
    """
    ours = [transform for transform in chain if isinstance(transform, Stateful)]
    for early, late in itertools.combinations(ours, 2):
        a, b = early.order, late.order
        for key in _both([*a.reads, *a.holds, *a.appends], b.makes):
            raise _wrong(late, early, f"{key} is made there and used here")
        for key in _both(a.records, b.replaces):
            raise _wrong(late, early, f"{key} must be recorded as it was chosen")
        for key in _both(a.appends, b.holds):
            raise _wrong(late, early, f"what it appends to {key} is known at once, not held back")


def _wrong(first: Transform, second: Transform, why: str) -> InputError:
    names = type(second).__name__, type(first).__name__
    return InputError(f"order of transforms: {names[0]} must come after {names[1]}, as {why}")


def _both(some: Sequence[NestedKey], others: Sequence[NestedKey]) -> list[NestedKey]:
    return [key for key in some if key in others]


def _leaves(compose: Compose) -> list[Transform]:
    """The transforms of nested Composes, in order."""
    return [leaf for t in compose for leaf in (_leaves(t) if isinstance(t, Compose) else [t])]


def row_shape(tensordict: TensorDictBase, key: NestedKey) -> torch.Size:
    """The batch size of the TensorDict in which an entry lies."""
    inner = tensordict.get(key[:-1]) if isinstance(key, tuple) and len(key) > 1 else tensordict
    return inner.batch_size


def as_rows(value: Tensor, shape: torch.Size) -> Tensor:
    """An entry [*shape, ...] as [M, ...], without its gradient."""
    return value.detach().reshape(shape.numel(), *value.shape[len(shape) :])


def flag_rows(tensordict: TensorDictBase, name: str, key: NestedKey, shape: torch.Size) -> Tensor | None:
    """The flag ``name`` (such as ``_reset`` or ``done``) that governs an entry, for each of its rows [M].

    The one nearest to the entry counts, from its own TensorDict outwards; None if there is none.
    """
    path = key[:-1] if isinstance(key, tuple) else ()
    for depth in range(len(path), -1, -1):
        flag = tensordict.get((*path[:depth], name), None)
        if flag is not None:
            flag = flag.any(-1)
            return flag.view(*flag.shape, *[1] * (len(shape) - flag.dim())).expand(shape).reshape(-1)
    return None


def beside(key: NestedKey, name: NestedKey | None) -> NestedKey | None:
    """A bare name as a key beside another one: ``age`` beside ``("agents", "observation")``."""
    if name is None or not isinstance(name, str) or isinstance(key, str):
        return name
    return (*key[:-1], name)


def wide(mask: Tensor, like: Tensor) -> Tensor:
    """A mask [M] as [M, 1, ...]."""
    return mask.view(-1, *[1] * (like.dim() - 1))
