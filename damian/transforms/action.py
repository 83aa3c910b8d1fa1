"""A transform that delays actions (paper, section 3.3), and what transforms that remember actions
share."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, MultiCategorical, OneHot, TensorSpec

from damian.common.errors import InputError
from damian.delays.laws import sampler_of
from damian.delays.line import DelayLine
from damian.delays.samplers import HeldSampler
from damian.transforms.base import Change, Memory, StatefulTransform
from damian.transforms.context import ContextReader
from damian.transforms.entries import Entries, existing, sibling_key, spec_rows

_INITIAL = ("initial", "initial_beside")
"""Names in the memory of the default actions, and of what travels with them."""


class ActionSpecs(NamedTuple):
    """Actions in the shape of their spec, [*rows, ...]; a row is a world, or an agent of a
    world."""

    rows: torch.Size
    """Batch size of the actions' TensorDict, as the specs give it."""
    initial: Tensor
    """Default actions, [*rows, ...]."""
    low: Tensor
    """Lower bound of each number of an action, [*rows, ...] float32."""
    width: Tensor
    """Upper minus lower bound, [*rows, ...] float32; 1 without bounds, with one value only, or
    one-hot."""
    bounded: bool
    """Whether (action - low) / width lies in [0, 1] for every number of an action."""


def _range(spec: TensorSpec) -> tuple[Tensor, Tensor]:
    """Lowest and highest values of each number of an action, in the shape and type of the
    actions."""
    if isinstance(spec, MultiCategorical):  # before Categorical, which is its base class
        low = 0
        high = spec.nvec - 1
    elif isinstance(spec, Categorical):
        low = 0
        high = spec.n - 1
    else:
        low, high = spec.space.low, spec.space.high  # type: ignore[union-attr]
    low, high = (
        torch.as_tensor(each, dtype=spec.dtype, device=spec.device) for each in (low, high)
    )
    return low.expand(spec.shape), high.expand(spec.shape)


def _default_action(space: tuple[Tensor, Tensor], default: Any) -> Tensor:
    """The default action in the shape and type of the range."""
    low, high = space
    if default is None:
        return torch.maximum(torch.minimum(torch.zeros_like(low), high), low)
    value = torch.as_tensor(default, dtype=low.dtype, device=low.device).expand(low.shape)
    if not bool(((value >= low) & (value <= high)).all()):
        bounds = f"{low.min().item() + 0} and {high.max().item() + 0}"
        raise InputError(
            f"default: {default} is not a legal default action, which lies between {bounds}"
        )
    return value


class ActionTransform(StatefulTransform):
    """Base class of transforms that remember actions."""

    def __init__(self, action_key: NestedKey, default: Any, seed: int | None = None) -> None:
        super().__init__(in_keys_inv=action_key, seed=seed)
        self.action_key: NestedKey = self.in_keys_inv[0]
        self.default = default

    @property
    def row_key(self) -> NestedKey:
        return self.action_key

    def action_rows(self, value: Tensor) -> Tensor:
        """A value of ``actions`` for each of the M rows, [M, ...]."""
        return self.as_rows_of_spec(value, self.env.full_action_spec, self.action_key)

    @property
    def actions(self) -> ActionSpecs:
        """Shape, range and default of the actions, by the environment's specs."""
        specs = self.env.full_action_spec
        spec = specs[self.action_key]
        rows = spec_rows(specs, self.action_key)
        if isinstance(spec, OneHot):
            indices = spec.to_categorical_spec()
            initial = indices.to_one_hot(_default_action(_range(indices), self.default)).to(
                spec.dtype
            )
            low = torch.zeros_like(initial, dtype=torch.float32)
            return ActionSpecs(rows, initial, low, torch.ones_like(low), True)
        space = _range(spec)
        low, high = (bound.float() for bound in space)
        width = high - low
        bounded = isinstance(spec, Categorical | Bounded) & width.isfinite()
        low = torch.where(bounded, low, 0)
        width = torch.where(bounded & (width > 0), width, 1)
        return ActionSpecs(
            rows, _default_action(space, self.default), low, width, bool(bounded.all())
        )


class ActionDelay(ActionTransform):
    """Delays actions: the environment executes the action that the policy chose some steps ago.

    Until the first action of an episode arrives, the environment executes a default action. In a
    step in which no newer action arrives, it executes the same action again: the newest wins, and
    one that arrives after a newer one is dropped. The TensorDict keeps the chosen action. With
    delay 0 the rollout is the same, bit for bit, as without the transform.

    A worked timeline, with a delay of 3 steps: the action a0, chosen at t = 0, is executed in the
    step that begins at t = 3; the steps that begin at t = 0, 1 and 2 execute the default action.

    Args:
        delay, dt, context_keys, seed: as in ``ObservationDelay``; the policy's input and the
            outputs of a reset must have the entries that the law reads.
        action_key: key of the action. A bare name for another key means an entry beside it.
        default: action that is executed until the first one arrives: a number, or values in the
            shape of an action; an index for discrete and one-hot actions. If not given, the legal
            value nearest to 0.
        loss: probability that an action never arrives.
        hold: execute each action when the longest delay has passed, so that none is dropped: a
            jitter buffer, with which methods for constant delays work under random ones.
        sent_key: key of a flag in the policy's input, [...] bool: which actions are sent; if not
            given, all.
        valid_key: key of a flag that is written for the environment, [...] bool: true if the action
            is executed for the first time, or is the default. A ``ParallelEnv`` passes it on only
            if its specs name it.

    Examples:
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), ActionDelay(2))
        >>> rollout = env.rollout(100)  # each action is executed two steps after it was chosen
    """

    def __init__(
        self,
        delay: Any,
        action_key: NestedKey = "action",
        *,
        default: Any = None,
        loss: float = 0.0,
        hold: bool = False,
        dt: float = 1.0,
        sent_key: NestedKey | None = None,
        valid_key: NestedKey | None = None,
        context_keys: Mapping[str, NestedKey] | None = None,
        seed: int | None = None,
    ) -> None:
        super().__init__(action_key, default, seed)
        self.out_keys_inv = self.in_keys_inv
        sampler = sampler_of(delay, dt, loss)
        self.sampler = HeldSampler(sampler) if hold else sampler
        self.line = DelayLine(self.sampler, "generation")
        self.sent_key, self.valid_key = (
            sibling_key(self.action_key, key) for key in (sent_key, valid_key)
        )
        self.contexts = ContextReader(
            self.sampler, context_keys, dt, self.action_key, before_step=True
        )
        self.action_keys = existing([self.action_key, self.sent_key, *self.contexts.keys.values()])

    @property
    def required_keys(self) -> Sequence[NestedKey]:
        return [*self.contexts.keys.values()]

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        first = self.begins()
        streams = self.streams(tensordict.batch_size, first[0].device, self.sampler)
        memory = self.line.init_memory(first, streams) | dict(zip(_INITIAL, first, strict=False))
        return self.contexts.init_memory(memory, tensordict, self.rows)

    def begins(self) -> list[Tensor]:
        """The default action of each row, and what travels with it, [M, ...] each."""
        return [self.action_rows(self.actions.initial)]

    def beside(self, memory: Memory, entries: Entries) -> list[Tensor]:
        """What travels with the actions that are chosen now, [M, ...] each."""
        return []

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        first = [memory[name] for name in _INITIAL if name in memory]
        return self.line.reset(memory, first, mask)[0], {}

    def on_action(self, memory: Memory, entries: Entries) -> Change:
        # A distribution may draw one-hot actions as floats, where the specs have integers.
        chosen = self.to_rows(entries[self.action_key]).to(memory["initial"].dtype)
        sent = self.sending_rows(entries)
        context = self.contexts.read(memory, entries, sent, self.rows)
        sends = [chosen, *self.beside(memory, entries)]
        memory, delivery = self.line.step(memory, sends, sent, context)
        executed: Entries = {self.action_key: self.from_rows(delivery.held[0]).clone()}
        if self.valid_key:
            default = memory["generated_at"] == memory["reset_at"]
            executed[self.valid_key] = (delivery.fresh | default).view(self.rows)
        return memory, executed
