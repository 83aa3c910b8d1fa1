"""Shape, range and default of an environment's actions, read from its action spec."""

from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, MultiCategorical, MultiOneHot, OneHot, TensorSpec
from torchrl.envs import EnvBase

from damian.transforms.base import StatefulTransform
from damian.transforms.entries import as_rows, require_keys, spec_rows


class ActionSpecs(NamedTuple):
    """Actions of M rows; a row is a world, or an agent of a world."""

    rows: torch.Size
    """Batch size of the actions' TensorDict; its elements are the M rows."""
    initial: Tensor
    """Default actions, [M, ...]."""
    low: Tensor
    """Lower bound of each number of an action."""
    width: Tensor
    """Upper minus lower bound of each number of an action; 1 where actions have no bounds, or are one-hot."""
    bounded: bool
    """Whether (action - low) / width lies in [0, 1] for every number of an action."""


def read_action_specs(env: EnvBase, key: NestedKey, default: Any) -> ActionSpecs:
    """Read the action spec of an environment.

    Args:
        env: environment that has the action.
        key: key of the action.
        default: default action: a number, or values in the shape of an action (an index for discrete
            actions); if None, the legal value nearest to 0.
    """
    spec, rows = env.full_action_spec[key], spec_rows(env.full_action_spec, key)
    value = torch.as_tensor(0 if default is None else default, device=spec.device)
    if isinstance(spec, MultiOneHot):
        blocks = [one.n for one in spec.space]
        first = torch.cat([torch.nn.functional.one_hot(torch.tensor(0), n) for n in blocks])
        initial = (first if default is None else value).to(spec.device, spec.dtype).expand(spec.shape).clone()
    elif isinstance(spec, OneHot):
        index = value.long().expand(spec.shape[:-1])
        initial = torch.nn.functional.one_hot(index, spec.shape[-1]).to(spec.dtype)
    else:
        initial = value.to(spec.dtype).expand(spec.shape).clone()
        initial = spec.project(initial) if default is None else initial  # type: ignore[arg-type]
    return ActionSpecs(rows, as_rows(initial, rows), *_range(spec, rows))


def _range(spec: TensorSpec, rows: torch.Size) -> tuple[Tensor, Tensor, bool]:
    """Lower bound and width of the range of each number of an action, and whether all have a range."""
    if isinstance(spec, MultiCategorical):  # before Categorical, of which it is a subclass
        width = spec.nvec.view(-1, spec.shape[-1])[0] - 1
        return torch.zeros_like(width), width.clamp(min=1).to(spec.device), True
    if isinstance(spec, Categorical):
        width = torch.tensor(max(spec.n - 1, 1), device=spec.device)
        return torch.zeros_like(width), width, True
    if isinstance(spec, Bounded) and spec.dtype.is_floating_point:
        low, high = (as_rows(bound, rows)[0] for bound in (spec.low, spec.high))
        bounded = (high - low).isfinite()
        return torch.where(bounded, low, 0), torch.where(bounded, high - low, 1), bool(bounded.all())
    one_hot = isinstance(spec, OneHot)
    return torch.zeros((), device=spec.device), torch.ones((), device=spec.device), one_hot


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
        return self.actions.rows

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
