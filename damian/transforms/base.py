"""The base class of transforms with memory, the order in which they must stand, and how seeds reach
them."""

import itertools
import multiprocessing
import warnings
from collections.abc import Callable, Collection, Sequence
from functools import cached_property
from typing import Any, NamedTuple, NoReturn, cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import (
    Compose,
    EnvBase,
    RandomTruncationTransform,
    StepCounter,
    TerminateTransform,
    Transform,
    TransformedEnv,
)

from damian.common import counter_rng
from damian.common.errors import InputError
from damian.common.tensors import where_rows
from damian.delays.line import Memory
from damian.delays.samplers import Sampler, streams_for
from damian.keys import DONE, STEPPED
from damian.transforms.entries import (
    Entries,
    Keys,
    as_rows,
    path_of,
    require_keys,
    reset_rows,
    select_entries,
    spec_rows,
)

STAGES = ("server", "delay", "history")
"""The order of damian's transforms that share a key, from the environment outwards."""

Change = tuple[Memory, Entries]
"""The new memory of a transform, and the entries that it writes."""


class Correction(NamedTuple):
    """How the entries that a transform has changed are corrected in stored steps
    (``BackupdateStorage``)."""

    correct: Callable[[Entries, TensorDictBase, Tensor], Entries]
    """Pure function of the entries after the steps as they are known by now, the stored steps
    [T, B], and the
    number of earlier steps in each episode [T, B]: the entries as the transform would have written
    them."""
    lookback: int = 0
    """Number of earlier steps on which the entries after a step depend."""
    paid: Callable[[TensorDictBase, Tensor], Tensor] | None = None
    """Only of late rewards: whether the reward of each step [T, B] has been paid by the last
    step."""
    delay_key: NestedKey | None = None
    """Only of late rewards: key of the delay of each reward [steps]."""


class StatefulTransform(Transform):
    """Base class of transforms that remember earlier steps of each world, or of each agent of each
    world.

    The memory has M rows: one for each element of the innermost TensorDict of a nested key, such as
    ``("agents", "observation")``; for an entry at the root, one for each world. It is allocated at
    the first reset and kept in buffers, which ``state_dict`` saves by reference: clone them before
    the next step, as some are written in place.

    An agent whose own flag ``done`` falls in the middle of an episode has joined it again, and
    begins anew.

    A subclass implements pure functions of its memory and of entries: ``on_reset``, ``on_action``
    (before the environment steps) and ``on_step`` (after it). TorchRL's hooks call them for one
    transform; ``DelayedEnv`` calls them for several, which compile into one graph. No gradient
    flows through the memory.

    Args:
        in_keys, in_keys_inv: keys of entries, and of actions, that the transform changes or sends.
        out_keys, out_keys_inv: keys of the entries that it writes, and under which the policy
            writes actions.
        seed: of all draws, until ``damian.set_seed`` gives another; if not given, it is drawn from
            torch's global generator at the first reset.
    """

    stage: str = "delay"
    """One of ``STAGES``."""
    flushes_at_end: bool = False
    """Whether it delivers what is still in transit in the last step of an episode."""
    is_of_rewards: bool = False
    """Whether it changes rewards; that of the step in which an agent joins again is of its new
    life."""
    action_keys: Sequence[NestedKey] = ()
    """Keys of the entries that are passed to ``on_action``, if they exist."""
    step_keys: Sequence[NestedKey] = ()
    """Keys of the entries that are passed to ``on_reset`` and ``on_step``; see
    ``required_keys``."""
    sent_key: NestedKey | None = None
    """Key of the flag that says which rows send a message in this step; None if all do."""
    _rows: torch.Size | None = None
    _seed: int | None = None
    _world_seeds: Tensor | None = None
    _first: TensorDictBase | None = None
    """Outputs of a reset of all worlds, as long as no step follows it."""
    _in_episode: bool = False
    """Whether a reset of the environment has begun the episodes that its worlds are in."""

    def __init__(
        self,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
        in_keys_inv: Keys | None = None,
        out_keys_inv: Keys | None = None,
        seed: int | None = None,
    ) -> None:
        super().__init__(*(keys or None for keys in (in_keys, out_keys, in_keys_inv, out_keys_inv)))
        self._seed = seed

    # Pure functions, for subclasses.

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        """Begin new episodes in the rows of the mask [M], given the outputs ``step_keys`` of the
        reset."""
        return memory, {}

    def on_action(self, memory: Memory, entries: Entries) -> Change:
        """Change the inputs ``action_keys`` of a step on their way from the policy to the
        environment."""
        return memory, {}

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        """Change the outputs ``step_keys`` of a step; the memory is that after ``on_action``."""
        return memory, {}

    def hindsight(self, keys: Collection[NestedKey]) -> Correction | None:
        """How stored entries are corrected where this transform changed any of ``keys``; else None.

        ``keys``: entries that are computed again from late messages, without ``"next"``, and the
        rewards.
        """
        return None

    # What a transform is, for subclasses.

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        """Allocate the memory, given the outputs of the first reset."""
        return {}

    @property
    def required_keys(self) -> Sequence[NestedKey]:
        """Keys of the entries that the environment must output before this transform."""
        return self.step_keys or self.in_keys

    @property
    def row_key(self) -> NestedKey:
        """Key of an entry whose innermost TensorDict has one element for each row."""
        return [*self.in_keys, *self.in_keys_inv][0]

    @property
    def created_keys(self) -> Sequence[NestedKey]:
        """Keys of the entries that the transform adds to the outputs of the environment."""
        return [key for key in self.out_keys if key not in self.in_keys]

    # The memory.

    @property
    def has_memory(self) -> bool:
        """Whether the memory has been allocated, by a reset or by ``load_state_dict``."""
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
        # No entry of the group is in the outputs. The specs lack leading dimensions of a batch that
        # is chosen at a reset (``batch_locked`` is false, as in TorchRL's ``PendulumEnv``).
        kinds = (self.env.full_action_spec, self.env.full_reward_spec)
        inner_specs = next(specs[path] for specs in kinds if path in specs.keys(True))
        return torch.Size((*tensordict.batch_size, *inner_specs.shape[len(self.env.batch_size) :]))

    def as_rows_of_spec(self, value: Tensor, specs: Composite, key: NestedKey) -> Tensor:
        """A value in the shape of the spec under a key, for each of the M rows, [M, ...]."""
        inner = value.shape[len(spec_rows(specs, key)) :]
        return self.to_rows(value.expand((*self.rows, *inner))).clone()

    def to_rows(self, value: Tensor) -> Tensor:
        """An entry [*rows, ...] as [M, ...]."""
        return as_rows(value, self.rows)

    def from_rows(self, value: Tensor) -> Tensor:
        """The entry [*rows, ...] of [M, ...]."""
        return value.view((*self.rows, *value.shape[1:]))

    @property
    def memory(self) -> Memory:
        """The memory of the transform: its buffers by name."""
        return cast(Memory, dict(self._buffers))

    def set_memory(self, memory: Memory) -> None:
        """Replace the buffers that have these names."""
        self._first = None
        self._buffers.update(memory)

    def clear_memory(self) -> None:
        """Delete the memory; the next reset counts as the first."""
        self._rows = None
        self._buffers.clear()

    def expand_worlds(self, worlds: Tensor) -> Tensor:
        """Expand a mask of worlds [B] to a mask of rows [M]."""
        return worlds.view(-1, 1).expand(-1, self.rows.numel() // len(worlds)).reshape(-1)

    def sending_rows(self, entries: Entries) -> Tensor | None:
        """The rows that send a message in this step, [M] bool; None if all do."""
        sending = None if self.sent_key is None else entries[self.sent_key].reshape(-1)
        if STEPPED not in entries:
            return sending
        stepped = self.expand_worlds(entries[STEPPED].reshape(-1))
        return stepped if sending is None else sending & stepped

    # TorchRL's hooks.

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        mask = reset_rows(tensordict, self.row_key, self.rows) if self.has_memory else None
        if mask is None and self.has_memory and self.find_rows(tensordict_reset) != self.rows:
            self.clear_memory()  # the number of worlds may be chosen at a reset
        if not self.has_memory:
            self._init(tensordict_reset)
        outputs = tensordict_reset.detach() if mask is None else None
        # TorchRL restores the entries of the worlds without a reset.
        written = self._write(tensordict_reset, self._change_at_reset(tensordict_reset, mask))
        self._first = outputs
        self._in_episode = True
        return written

    def _init(self, outputs: TensorDictBase) -> None:
        """Allocate the memory, given the outputs of the first reset."""
        container = cast(EnvBase, self.container)
        check_order(all_transforms(container))
        require_keys(
            type(self).__name__, self.in_keys_inv, self.env.full_action_spec.keys(True, True)
        )
        _ = container.output_spec  # checks all other keys
        self._rows = self.find_rows(outputs)
        with torch.inference_mode(
            False
        ):  # else the buffers could be written only in inference mode
            self.set_memory(self.init_memory(outputs))

    def _change_at_reset(self, outputs: TensorDictBase, mask: Tensor | None) -> Change:
        """Begin new episodes in the rows of the mask [M], or in all, given the outputs of the
        reset."""
        memory = self.memory
        if mask is None:
            device = next((value.device for value in memory.values()), None)
            mask = torch.ones(self.rows.numel(), dtype=torch.bool, device=device)
        return self.on_reset(memory, select_entries(outputs, self.step_keys), mask)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not self.action_keys:
            return tensordict
        self.require_memory()
        entries = select_entries(tensordict, [*self.action_keys, STEPPED])
        change = self.on_action(self.memory, entries)
        if STEPPED in entries:
            change = self._only_stepped(change, entries[STEPPED], tensordict, tensordict)
        return self._write(tensordict, change)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.require_memory()
        entries = select_entries(next_tensordict, self.step_keys)
        stepped = tensordict.get(STEPPED, None)
        sent = entries if stepped is None else entries | {STEPPED: stepped}
        rejoined = self._rejoined_rows(tensordict, next_tensordict)
        if rejoined is None:
            change = self.on_step(self.memory, sent)
        elif self.is_of_rewards:
            change = self.on_step(self.on_reset(self.memory, entries, rejoined)[0], sent)
        else:
            change = self._begin_again(self.on_step(self.memory, sent), entries, rejoined)
        if stepped is not None:
            change = self._only_stepped(change, stepped, tensordict, next_tensordict)
        return self._write(next_tensordict, change)

    @cached_property
    def _own_done_key(self) -> NestedKey | None:
        """Key of the flag of each agent that its episode has ended; None if only worlds have
        one."""
        path = path_of(self.row_key)
        return (*path, DONE) if path and (*path, DONE) in self.env.done_keys else None

    def _rejoined_rows(self, before: TensorDictBase, after: TensorDictBase) -> Tensor | None:
        """The rows whose agents have joined again in a step, [M] bool; None if none can."""
        key = self._own_done_key
        ended = None if key is None else before.get(key, None)
        if ended is None or ended.shape[:-1] != self.rows:  # the links of a ``Channel`` go on
            return None
        return (ended & ~after.get(key)).reshape(-1)

    def _begin_again(self, change: Change, entries: Entries, rows: Tensor) -> Change:
        """A change after which these rows [M] hold what they send in this step as their first
        message."""
        memory, first = self.on_reset(change[0], entries, rows)
        merged = dict(change[1])
        for key, new in first.items():
            begun = self.to_rows(new)
            old = self.to_rows(merged[key])
            merged[key] = self.from_rows(where_rows(rows, begun, old))
        return memory, merged

    def _only_stepped(
        self, change: Change, stepped: Tensor, before: TensorDictBase, after: TensorDictBase
    ) -> Change:
        """Undo a change in the worlds that do not step: ``before`` has their entries, or else
        ``after``.

        Buffers that a step writes in place are right already, as ``on_step`` knows who has stepped.
        """
        rows = self.expand_worlds(stepped.reshape(-1))
        memory = self.memory
        for name, new in change[0].items():
            if new is not memory[name]:
                memory[name] = where_rows(rows, new, memory[name])
        merged = {}
        for key, new in change[1].items():
            # A later transform that widens an entry restores it itself.
            found = (td.get(key, None) for td in (before, after))
            same_shape = (
                value for value in found if value is not None and value.shape == new.shape
            )
            old = next(same_shape, torch.zeros_like(new))
            new_rows = self.to_rows(new)
            old_rows = self.to_rows(old)
            merged[key] = self.from_rows(where_rows(rows, new_rows, old_rows))
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
        return tensordict

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """The specs with those of what the transform writes; all keys are checked."""
        specs = [spec for spec in output_spec.values() if spec is not None]
        present = [key for spec in specs for key in spec.keys(True, True)]
        name = type(self).__name__
        require_keys(name, self.required_keys, present)
        taken = next((key for key in self.created_keys if key in present), None)
        if taken is not None:
            raise InputError(
                f"{name}: {taken} is already an entry of the environment: choose another name"
            )
        return super().transform_output_spec(output_spec)

    @property
    def env(self) -> EnvBase:
        """The environment with the transforms before this one."""
        parent = self.parent
        if parent is None:
            self._refuse()
        return parent

    def require_memory(self) -> None:
        """Refuse a step before the first reset."""
        if not self.has_memory and self._first is not None:  # it was seeded after the reset
            outputs = self._first
            self._init(outputs)
            self.set_memory(self._change_at_reset(outputs, None)[0])
        if not self.has_memory:
            self._refuse()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._refuse()

    def _refuse(self) -> NoReturn:
        name = type(self).__name__
        raise RuntimeError(
            f"{name} remembers earlier steps, so it works only in an environment, after a reset: "
            f"TransformedEnv(env, {name}(...)); for stored steps: "
            "examples/transforms/late_replay_buffer.py"
        )

    # Copies and checkpoints.

    def __setstate__(self, state: dict[str, Any]) -> None:
        """A copy has memory of its own: what was sent to a worker process would share the
        sender's."""
        super().__setstate__(state)
        self._buffers = {
            name: value.clone() if value is not None and value.is_shared() else value
            for name, value in self._buffers.items()
        }

    def clone(self) -> "StatefulTransform":
        """A copy of the transform without memory."""
        copied = super().clone()
        copied.clear_memory()
        copied._first = None
        copied.leave_episode()
        return copied

    def reset_parent(self) -> None:
        super().reset_parent()
        self.forget_specs()
        self.leave_episode()

    def forget_specs(self) -> None:
        """Forget what has been read from the environment's specs, which ``cached_property``
        keeps."""
        for name in [
            n for n in self.__dict__ if isinstance(getattr(type(self), n, None), cached_property)
        ]:
            del self.__dict__[name]

    def leave_episode(self) -> None:
        """Let ``load_state_dict`` replace the whole memory, because the worlds are replaced,
        too."""
        self._in_episode = False

    def get_extra_state(self) -> Tensor | None:
        """The shape of the rows, for ``state_dict``."""
        return None if self._rows is None else torch.tensor(self._rows, dtype=torch.long)

    def set_extra_state(self, state: Tensor | None) -> None:
        """Set the shape of the rows from a ``state_dict``."""
        self._rows = None if state is None else torch.Size(state.tolist())

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        """Load the memory. A state without entries of this transform makes the next reset the
        first.

        A state does not tell where the environment's worlds are, so an episode that the environment
        is in goes on with its own messages, as TorchRL's collectors need it: right after a reset,
        the random streams are loaded; later, nothing.
        """
        first = self._first if self._in_episode else None
        errors = args[-1]
        if self._in_episode and first is None:
            text = (
                "in the middle of an episode no state is loaded: load it before a reset or right "
                "after one"
            )
            warnings.warn(f"{type(self).__name__}: {text}", stacklevel=2)
            return
        inner = {k.removeprefix(prefix): v for k, v in state_dict.items() if k.startswith(prefix)}
        saved: Memory = {
            k: v.detach() for k, v in inner.items() if "." not in k and k != "_extra_state"
        }
        own = self.memory
        self.clear_memory()
        self.set_memory({k: own.get(k, v).clone() for k, v in saved.items()})
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
        if first is not None and not errors:
            if self.has_memory:
                self.set_memory(self._change_at_reset(first, None)[0])
            self._first = first

    # Random streams.

    def set_seed(self, seed: int | None) -> None:
        """Set the seed and delete the memory; the next step or reset allocates it again."""
        self._seed = seed
        self._world_seeds = None
        self.clear_memory()

    def seed_worlds(self, seeds: Tensor) -> None:
        """Set a seed for each world, [B] integers: a world's draws then do not depend on the other
        worlds."""
        self._seed = None
        self._world_seeds = seeds.to(torch.long)
        self.clear_memory()

    def streams(self, batch: torch.Size, device: torch.device, sampler: Sampler) -> Tensor:
        """A random stream (a key of the counter-based generator) for each row, [M] int64, 0 if none
        draws."""
        n_worlds = batch.numel()
        n_agents = self.rows.numel() // n_worlds
        if sampler.constant_delay is not None:
            return torch.zeros(self.rows.numel(), dtype=torch.long, device=device)
        if self._world_seeds is not None:
            worlds = self._world_seeds.to(device)
        else:
            seed = self._seed
            if (
                seed is None
            ):  # worker processes with the same state of torch's generator get different ones
                process = multiprocessing.current_process().name
                seed = int(torch.randint(2**62, ())) ^ counter_rng.number_of(process)
            worlds = counter_rng.world_seeds(seed, n_worlds, device)
        # The name keeps these streams apart from those of all other transforms in the environment.
        keys = (self.in_keys, self.in_keys_inv)
        others = [other for other in all_transforms(self.container) if type(other) is type(self)]
        alike = [other for other in others if (other.in_keys, other.in_keys_inv) == keys]
        place = next((i for i, other in enumerate(alike) if other is self), 0)
        number = counter_rng.number_of(f"{type(self).__name__} {keys[0]} {keys[1]} {place}")
        agents = torch.arange(n_agents, device=device)
        streams = counter_rng.bits64(worlds.view(-1, 1), number, agents)
        return streams_for(sampler, streams.flatten(), n_agents)


# The order of transforms.


def check_order(transforms: Sequence[Transform]) -> None:
    """Refuse an order, as outputs pass the transforms, in which one undoes or misses what another
    does.

    Raises ``InputError`` if a transform reads what one of an earlier stage changes after it, or if
    rewards in transit would be lost at an end of the episode.
    """
    for first, second in itertools.combinations(transforms, 2):
        problem = None
        limits = isinstance(second, StepCounter) and second.max_steps is not None
        ends = limits or isinstance(second, RandomTruncationTransform | TerminateTransform)
        if isinstance(first, StatefulTransform) and isinstance(second, StatefulTransform):
            read = {*first.in_keys, *first.in_keys_inv}
            shared = read.intersection([*second.out_keys, *second.out_keys_inv])
            if shared and STAGES.index(first.stage) > STAGES.index(second.stage):
                problem = f"it reads {shared.pop()}, which the other one changes"
        elif isinstance(first, StatefulTransform) and first.flushes_at_end and ends:
            problem = "what is in transit at the end of an episode would be lost"
        if problem:
            names = type(first).__name__, type(second).__name__
            raise InputError(
                f"order of transforms: {names[0]} must come after {names[1]}: {problem}"
            )


def leaf_transforms(transform: Transform | None) -> list:
    """All transforms of a Compose and of the Composes within it, in order; or the one transform."""
    if transform is None:
        return []
    if not isinstance(transform, Compose):
        return [transform]
    return [leaf for inner in transform for leaf in leaf_transforms(inner)]


def all_transforms(env: EnvBase | None) -> list[Transform]:
    """All transforms of an environment and of those within it, in the order in which outputs pass
    them."""
    if not isinstance(env, TransformedEnv):
        return []
    return [*all_transforms(env.base_env), *leaf_transforms(env.transform)]


# Seeds.


def set_seed(env: EnvBase, seed: int) -> int | None:
    """Seed an environment and the transforms of damian within it; returns the next seed, as TorchRL
    does.

    TorchRL's ``env.set_seed`` does not reach transforms, nor does this function reach worker
    processes. The seed holds from the next reset on, and right after a reset of all worlds at once.
    An environment of ``make_env`` needs only its own ``env.set_seed``.
    """
    for transform in all_transforms(env):
        if isinstance(transform, StatefulTransform):
            transform.set_seed(seed)
    return env.set_seed(seed)
