"""Shape, range and default of an environment's actions, read from its action spec."""

from typing import Any, NamedTuple, cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, MultiCategorical, OneHot, TensorSpec
from torchrl.data.tensor_specs import Stacked
from torchrl.envs import EnvBase

from damian.common import checks
from damian.common.errors import InputError
from damian.common.text_files import show
from damian.transforms.base import StatefulTransform
from damian.transforms.batches import expand_to_rows, rows_of_batch
from damian.transforms.entries import require_keys, spec_rows


class ActionSpecs(NamedTuple):
    """Actions in the shape of their spec, [*rows, ...]; a row is a world, or an agent of a world."""

    rows: torch.Size
    """Batch size of the actions' TensorDict, as the specs tell it."""
    initial: Tensor
    """Default actions, [*rows, ...]."""
    low: Tensor
    """Lower bound of each number of an action, [*rows, ...] float32."""
    width: Tensor
    """Upper minus lower bound of each number of an action, [*rows, ...] float32; 1 where actions have no
    bounds, can take one value only, or are one-hot."""
    bounded: bool
    """Whether (action - low) / width lies in [0, 1] for every number of an action."""


class _Range(NamedTuple):
    """Range of each number of an action, in the shape of the spec."""

    low: Tensor
    """Lowest value, in the type of the actions."""
    high: Tensor
    """Highest value, in the type of the actions."""
    bounded: Tensor
    """Whether the spec sets these bounds, bool; if not, they are those of the type of the actions."""


def read_action_specs(env: EnvBase, key: NestedKey, default: Any) -> ActionSpecs:
    """Read the action spec of an environment.

    Args:
        env: environment that has the action.
        key: key of the action.
        default: default action: a number, or values in the shape of an action (indices for one-hot actions);
            if None, the legal value nearest to 0.

    Raises:
        InputError: the default is no legal action.
    """
    specs = env.full_action_spec
    spec, rows = specs[key], spec_rows(specs, key)
    if isinstance(spec, OneHot):
        indices = spec.to_categorical_spec()
        initial = indices.to_one_hot(_default_action(_range(indices), default)).to(spec.dtype)
        low = torch.zeros_like(initial, dtype=torch.float32)
        return ActionSpecs(rows, initial, low, torch.ones_like(low), True)
    space = _range(spec)
    low = space.low.float()
    width = space.high.float() - low
    bounded = space.bounded & width.isfinite()
    low, width = torch.where(bounded, low, 0), torch.where(bounded & (width > 0), width, 1)
    return ActionSpecs(rows, _default_action(space, default), low, width, bool(bounded.all()))


def _range(spec: TensorSpec) -> _Range:
    """The range of each number of an action."""
    if isinstance(spec, Stacked):  # agents with different ranges
        parts = [_range(one) for one in spec._specs]  # type: ignore[arg-type]
        return _Range(*(torch.stack(part, spec.dim) for part in zip(*parts, strict=True)))
    bounded = isinstance(spec, Categorical | Bounded)
    if isinstance(spec, MultiCategorical):  # before Categorical, of which it is a subclass
        low, high = 0, spec.nvec - 1
    elif isinstance(spec, Categorical):
        low, high = 0, spec.n - 1
    else:
        low, high = spec.space.low, spec.space.high  # type: ignore[union-attr]
    low, high = (
        torch.as_tensor(bound, dtype=spec.dtype, device=spec.device).expand(spec.shape)
        for bound in (low, high)
    )
    return _Range(low, high, torch.full_like(low, bounded, dtype=torch.bool))


def _default_action(space: _Range, default: Any) -> Tensor:
    """The default action in the shape and type of the range.

    Raises:
        InputError: the default is no legal action.
    """
    low, high = space.low, space.high
    if default is None:
        return torch.maximum(torch.minimum(torch.zeros_like(low), high), low)
    real = low.is_floating_point()
    should = (
        f"is not a legal default action: {'numbers' if real else 'whole numbers'} between {_shown(low)} and "
        f"{_shown(high)}, one for all or in the shape {tuple(low.shape)}"
    )
    try:
        value = torch.as_tensor(default, dtype=low.dtype if real else None, device=low.device)
        value = value.expand(low.shape)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"default: {show(default)} {should}") from error
    legal = (real or not value.is_floating_point()) and bool(((value >= low) & (value <= high)).all())
    checks.require(legal, "default", show(default), should)
    return value.to(low.dtype)


def _shown(bound: Tensor) -> str:
    """The bounds of all numbers, as one number if they are all the same."""
    bound = bound + 0  # flags are 0 and 1
    values = bound.unique()
    return show(values.item() if len(values) == 1 else bound.tolist())


class ActionTransform(StatefulTransform):
    """Base class of transforms that remember actions.

    Args:
        action_key: key of the action.
        default: default action, as in ``read_action_specs``.
        keys: further arguments of ``StatefulTransform``.
    """

    def __init__(self, action_key: NestedKey, default: Any, **keys: Any) -> None:
        super().__init__(in_keys_inv=[action_key], **keys)
        self.action_key: NestedKey = self.in_keys_inv[0]
        self.default = default

    @property
    def row_key(self) -> NestedKey:
        return self.action_key

    def find_rows(self, tensordict: TensorDictBase) -> torch.Size:
        return rows_of_batch(tensordict.batch_size, self.env, self.actions.rows)

    def action_rows(self, value: Tensor) -> Tensor:
        """A value of ``actions`` for each of the M rows, [M, ...]."""
        return expand_to_rows(value, self.actions.rows, self.rows)

    def flag_to_require(self, key: NestedKey | None) -> list[NestedKey]:
        """The key of a flag in the policy's input, if a reset must output it before this transform.

        It need not if the specs of the whole environment name the flag: then a later transform may write it,
        or it may be a part of the action.
        """
        if key is None:
            return []
        env = cast(EnvBase, self.container)
        specs = (env.full_observation_spec, env.full_state_spec, env.full_action_spec, env.full_done_spec)
        named = {key for spec in specs for key in spec.keys(True, True)}
        return [] if key in named else [key]

    @property
    def actions(self) -> ActionSpecs:
        """Shape, range and default of the actions, read from the environment's specs once."""
        if "_actions" not in self.__dict__:
            require_keys(type(self).__name__, [self.action_key], self.env.full_action_spec)
            self.__dict__["_actions"] = read_action_specs(self.env, self.action_key, self.default)
        return self.__dict__["_actions"]

    def empty_cache(self) -> None:
        super().empty_cache()
        self.__dict__.pop("_actions", None)

    def reset_parent(self) -> None:
        super().reset_parent()
        self.__dict__.pop("_actions", None)
