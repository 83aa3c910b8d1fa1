"""What the transforms share: a memory that lives in buffers, seeds, and their order."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, NoReturn, cast

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import Compose, EnvBase, Transform

from damian.common import counter_rng
from damian.common.errors import InputError

Memory = dict[str, Tensor]
"""What a transform remembers, by the name of its buffer."""

Entries = dict[NestedKey, Tensor]
"""Entries of a TensorDict, by key."""

Change = tuple[Memory, Entries]
"""What is remembered from now on, and the entries that are written."""


class Uses(NamedTuple):
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


class Stateful(Transform):
    """A transform with a memory: one row for each world, or for each agent of each world.

    An entry under a nested key, such as ``("agents", "observation")``, has a row for each element of the
    batch size of its innermost TensorDict; an entry at the root has one for each world. The memory is made
    at the first reset, and kept in buffers: it is saved with ``state_dict`` (not as a copy: some of it is
    written in place), moves with ``to``, and travels into worker processes. The worlds are not in it.

    What a subclass does is written as pure functions of its memory and of entries, ``begin`` (after a
    reset), ``act`` (before a step) and ``see`` (after it), so that a whole chain compiles into one graph.

    Args:
        seed: of everything that is drawn; without one, drawn from torch's global generator at the first
            reset.
    """

    act_keys: Sequence[NestedKey] = ()
    """Entries that ``act`` is given, if they are there."""
    see_keys: Sequence[NestedKey] = ()
    """Entries that ``begin`` and ``see`` are given, if they are there."""
    drop: Sequence[NestedKey] = ()
    """Entries that are not passed on."""
    sent_key: NestedKey | None = None
    """Flag that says which rows send something now, if not all do."""

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

    # Pure, for subclasses.

    def begin(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        """Forget the rows of the mask [M], which begin with these entries of a reset."""
        return memory, {}

    def act(self, memory: Memory, entries: Entries) -> Change:
        """What the environment is told, of what the policy chose."""
        return memory, {}

    def see(self, memory: Memory, entries: Entries) -> Change:
        """What is shown, of what the environment shows after a step."""
        return memory, {}

    def only(self, before: Memory, after: Memory, moves: Tensor) -> Memory:
        """The memory after a step of the worlds of the mask [B] alone, in which no others sent anything."""
        rows = self.rows_of(moves)
        return {
            name: new if new is before[name] else torch.where(wide(rows, new), new, before[name])
            for name, new in after.items()
        }

    # Once, for subclasses.

    def allocate(self, tensordict: TensorDictBase) -> Memory:
        """The memory before the first reset, whose entries are given."""
        return {}

    def find_rows(self, tensordict: TensorDictBase) -> torch.Size:
        """The shape of the rows, at the first reset."""
        return row_shape(tensordict, self.row_key)

    @property
    def row_key(self) -> NestedKey:
        """An entry whose place says what a row is."""
        return self.in_keys[0]

    @property
    def uses(self) -> Uses:
        """What this transform does with which keys."""
        return Uses()

    # TorchRL's hooks.

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        mask = None
        if self.begun:
            self._check_rows(tensordict_reset)
            mask = flag_rows(tensordict, "_reset", self.row_key, self.rows)
        else:
            self._rows = self.find_rows(tensordict_reset)
            self.remember(self.allocate(tensordict_reset))
        if mask is None:
            device = next((value.device for value in self.memory.values()), None)
            mask = torch.ones(self.rows.numel(), dtype=torch.bool, device=device)
        change = self.begin(self.memory, taken(tensordict_reset, self.see_keys), mask)
        return self._write(tensordict_reset, change)  # TorchRL keeps what the other worlds showed

    def _check_rows(self, tensordict: TensorDictBase) -> None:
        rows = self.find_rows(tensordict)
        if rows != self.rows:
            raise RuntimeError(
                f"{type(self).__name__} remembers rows of {tuple(self.rows)}, but the environment has "
                f"{tuple(rows)}: the state of another one was loaded"
            )

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not self.act_keys:
            return tensordict
        self.check()
        return self._write(tensordict, self.act(self.memory, taken(tensordict, self.act_keys)))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.check()
        return self._write(next_tensordict, self.see(self.memory, taken(next_tensordict, self.see_keys)))

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._reset(tensordict, tensordict_reset)

    def _write(self, tensordict: TensorDictBase, change: Change) -> TensorDictBase:
        memory, entries = change
        self.remember(memory)
        for key, value in entries.items():
            tensordict.set(key, value)
        for key in self.drop:
            tensordict.pop(key, None)
        return tensordict

    # The memory.

    @property
    def begun(self) -> bool:
        """Is there a memory yet."""
        return self._rows is not None

    @property
    def rows(self) -> torch.Size:
        """The shape of the rows, M in all."""
        assert self._rows is not None
        return self._rows

    def rows_of(self, worlds: Tensor) -> Tensor:
        """A mask of worlds [B] as one of rows [M]."""
        return worlds.view(-1, 1).expand(-1, self.rows.numel() // len(worlds)).reshape(-1)

    @property
    def memory(self) -> Memory:
        """Everything that changes."""
        return cast(Memory, dict(self._buffers))

    def remember(self, memory: Memory) -> None:
        """Put what has changed in the place of what was."""
        self._buffers.update(memory)

    def forget(self) -> None:
        """Begin anew: the next reset is the first."""
        self._rows = None
        self._buffers.clear()

    def get_extra_state(self) -> Tensor | None:
        """The shape of the rows, for ``state_dict``."""
        return None if self._rows is None else torch.tensor(self._rows, dtype=torch.long)

    def set_extra_state(self, state: Tensor | None) -> None:
        """From ``state_dict``."""
        self._rows = None if state is None else torch.Size(state.tolist())

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        inner = {
            name.removeprefix(prefix): value for name, value in state_dict.items() if name.startswith(prefix)
        }
        saved = {k: v for k, v in inner.items() if "." not in k and k != "_extra_state"}
        devices = {name: buffer.device for name, buffer in self.memory.items()}
        self.forget()  # TorchRL also loads what holds nothing of ours: then the next reset is the first
        self.remember({k: v.detach().clone().to(devices.get(k, v.device)) for k, v in saved.items()})
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    def clone(self) -> "Stateful":
        """The same transform, with a memory of its own that is still empty."""
        copied = super().clone()
        copied.forget()
        return copied

    # Seeds.

    def set_seed(self, seed: int | None) -> None:
        """Draw everything anew from the next reset on, which is the first."""
        self._seed, self._world_seeds = seed, None
        self.forget()

    def seed_worlds(self, seeds: Tensor) -> None:
        """Give every world its own stream, [B] integers: it draws alone what it draws among others."""
        self._seed, self._world_seeds = None, seeds
        self.forget()

    def streams(self, batch: torch.Size, device: torch.device) -> Tensor:
        """A random stream for each row, [M]."""
        n_worlds = batch.numel()
        if self._world_seeds is not None:
            worlds = self._world_seeds.to(device)
        elif self._seed is not None:
            worlds = counter_rng.world_seeds(self._seed, n_worlds, device)
        else:
            worlds = torch.randint(2**32, (n_worlds,)).to(device)
        each = torch.arange(self.rows.numel() // n_worlds, device=device)
        return counter_rng.bits(worlds.view(-1, 1), each).flatten()

    # Where it may stand.

    def set_container(self, container: Any) -> None:
        super().set_container(container)
        while isinstance(container, Compose):
            check_order(_leaves(container))
            above = container.__dict__.get("_container")
            container = above() if above is not None else None

    @property
    def env(self) -> EnvBase:
        """The environment with the transforms in front of this one."""
        parent = self.parent
        if parent is None:
            self._refuse()
        return parent

    def check(self) -> None:
        """Refuse to work without an environment that has been reset."""
        if not self.begun or self.container is None:
            self._refuse()

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


def check_order(chain: Sequence[Transform]) -> None:
    """Refuse an order in which a transform undoes or misses another's work.

    Raises:
        InputError: names the two, the key, and which must come first.
    """
    ours = [transform for transform in chain if isinstance(transform, Stateful)]
    for early, late in itertools.combinations(ours, 2):
        a, b = early.uses, late.uses
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


def spec_rows(specs: Composite, key: NestedKey) -> torch.Size:
    """The same, told by specs."""
    return (specs[key[:-1]] if isinstance(key, tuple) and len(key) > 1 else specs).shape


def as_rows(value: Tensor, rows: torch.Size) -> Tensor:
    """An entry [*rows, ...] as [M, ...]."""
    return value.reshape(rows.numel(), *value.shape[len(rows) :])


def from_rows(value: Tensor, rows: torch.Size) -> Tensor:
    """Back again: [M, ...] as [*rows, ...]."""
    return value.view((*rows, *value.shape[1:]))


def taken(tensordict: TensorDictBase, keys: Sequence[NestedKey]) -> Entries:
    """Those of the entries that are there, without their gradients."""
    found = {key: tensordict.get(key, None) for key in keys}
    return {key: value.detach() for key, value in found.items() if value is not None}


def flag_rows(
    tensordict: TensorDictBase | Mapping[NestedKey, Tensor], name: str, key: NestedKey, rows: torch.Size
) -> Tensor | None:
    """The flag ``name`` (such as ``_reset`` or ``done``) that governs an entry, for each of its rows [M].

    The one nearest to the entry counts, from its own TensorDict outwards; None if there is none.
    """
    for flag_key in flag_keys(name, key):
        flag = tensordict.get(flag_key, None)
        if flag is not None:
            flag = flag.any(-1)
            return flag.view((*flag.shape, *[1] * (len(rows) - flag.dim()))).expand(rows).reshape(-1)
    return None


def flag_keys(name: str, key: NestedKey) -> list[NestedKey]:
    """Where a flag may stand that governs an entry, the nearest place first."""
    path = key[:-1] if isinstance(key, tuple) else ()
    return [(*path[:depth], name) for depth in range(len(path), 0, -1)] + [name]


def beside(key: NestedKey, name: NestedKey | None) -> NestedKey | None:
    """A bare name as a key beside another one: ``age`` beside ``("agents", "observation")``."""
    if name is None or not isinstance(name, str) or isinstance(key, str):
        return name
    return (*key[:-1], name)


def wide(mask: Tensor, like: Tensor) -> Tensor:
    """A mask [M] as [M, 1, ...]."""
    return mask.view(-1, *[1] * (like.dim() - 1))
