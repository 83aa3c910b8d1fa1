"""Actions that are executed late."""

from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, MultiCategorical, OneHot, TensorSpec
from torchrl.envs import EnvBase

from damian.delays import law_of
from damian.transforms.mailbox import Mailbox
from damian.transforms.stateful import Order, Stateful, as_rows, beside, flag_rows


class Actions(NamedTuple):
    """What a transform must know of an environment's actions."""

    spec: TensorSpec
    rows: torch.Size
    """One for each world, or for each agent of each world."""
    initial: Tensor
    """Taken before the first choice counts, [M, ...]."""
    low: Tensor
    """Least value of each number of an action."""
    width: Tensor
    """From the least to the largest; 1 where actions have no bounds, or are not numbers."""


def actions_of(env: EnvBase, key: NestedKey, default: Any) -> Actions:
    """Read the specs of an environment.

    Args:
        env: has the action.
        key: of the action.
        default: the initial action: a number, or an action's values (an index, if actions are discrete); 0
            or what is nearest to it, if None.
    """
    specs = env.full_action_spec
    spec = specs[key]
    rows = (specs[key[:-1]] if isinstance(key, tuple) else specs).shape
    value = torch.as_tensor(0 if default is None else default, device=spec.device)
    if isinstance(spec, OneHot):
        index = value.long().expand(spec.shape[:-1])
        initial = torch.nn.functional.one_hot(index, spec.shape[-1]).to(spec.dtype)
    else:
        initial = value.to(spec.dtype).expand(spec.shape).clone()
        initial = spec.project(initial) if default is None else initial  # type: ignore[arg-type]
    return Actions(spec, rows, as_rows(initial, rows), *_range(spec, rows))


def _range(spec: TensorSpec, rows: torch.Size) -> tuple[Tensor, Tensor]:
    """Least value and width of each number of an action."""
    if isinstance(spec, Categorical | MultiCategorical):
        width = torch.as_tensor(spec.n if isinstance(spec, Categorical) else spec.nvec) - 1
        return torch.zeros_like(width), width.clamp(min=1).to(spec.device)
    if isinstance(spec, Bounded) and spec.dtype.is_floating_point:
        low, high = (as_rows(bound, rows)[0] for bound in (spec.low, spec.high))
        bounded = (high - low).isfinite()
        return torch.where(bounded, low, 0), torch.where(bounded, high - low, 1)
    return torch.zeros((), device=spec.device), torch.ones((), device=spec.device)


class OnActions(Stateful):
    """A transform that remembers actions."""

    def __init__(self, action_key: NestedKey, default: Any, **keys: Any) -> None:
        super().__init__(in_keys_inv=[action_key], **keys)
        self.action_key: NestedKey = self.in_keys_inv[0]
        self.default = default

    @property
    def actions(self) -> Actions:
        """What the environment's specs say, read once."""
        if "_actions" not in self.__dict__:
            if self.parent is None:
                self._refuse()
            self.__dict__["_actions"] = actions_of(self.parent, self.action_key, self.default)
        return self.__dict__["_actions"]

    def empty_cache(self) -> None:
        super().empty_cache()
        self.__dict__.pop("_actions", None)

    def set_container(self, container: Any) -> None:
        super().set_container(container)
        self.__dict__.pop("_actions", None)

    def _chosen(self, tensordict: TensorDictBase) -> Tensor:
        """The actions that the policy chose, [M, ...]."""
        return as_rows(tensordict.get(self.action_key), self.actions.rows)

    def _flag(self, tensordict: TensorDictBase, key: NestedKey | None) -> Tensor | None:
        """A flag for each row, [M]; None if there is none."""
        flag = tensordict.get(key, None) if key else None
        return None if flag is None else flag.reshape(-1)


class ActionDelay(OnActions):
    """The environment executes what was chosen some steps ago; until the first choice arrives, a default.

    In a step at which nothing arrives the latest arrival is executed again. The chosen action stays in the
    data. Without a delay nothing changes, bit for bit.

    Args:
        delay: a law, steps, or a time (``damian.delays.law_of``); drawn for each world, each agent and step.
        action_key: the action.
        default: executed until the first choice arrives: a number, or values of an action's shape; the
            index, if actions are discrete. 0 or the value nearest to it, if not given.
        loss: probability that a choice never arrives.
        dt: length of a step [s], for laws in time.
        sent_key: flag that the policy sees: only where it is true is there a choice to be sent, [...] bool.
        fresh_key: written for the environment: is something executed for the first time (or the default),
            [...] bool.
        seed: of the delays.

    A bare name for one of the last keys means one beside the action.

    Raises:
        InputError: an impossible law.
    """

    def __init__(
        self,
        delay: Any,
        action_key: NestedKey = "action",
        *,
        default: Any = None,
        loss: float = 0.0,
        dt: float = 1.0,
        sent_key: NestedKey | None = None,
        fresh_key: NestedKey | None = None,
        seed: int | None = None,
    ) -> None:
        super().__init__(action_key, default, out_keys_inv=[action_key], seed=seed)
        self.mailbox = Mailbox(law_of(delay).sampler(dt, loss), "generation", 1)
        self.sent_key, self.fresh_key = (beside(self.action_key, key) for key in (sent_key, fresh_key))

    def compile(self) -> None:  # type: ignore[override]
        """Compile what a step computes."""
        self.mailbox.compile()

    @property
    def order(self) -> Order:
        return Order(replaces=[self.action_key])

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        rows, initial = self.actions.rows, self.actions.initial
        if not self.mailbox.begun:
            streams = self._streams(tensordict_reset.batch_size, rows, initial.device)
            self.mailbox.allocate([initial], streams)
        self.mailbox.begin([initial], flag_rows(tensordict, "_reset", self.action_key, rows))
        return tensordict_reset

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.container is None or not self.mailbox.begun:
            self._refuse()
        chosen, rows = self._chosen(tensordict), self.actions.rows
        came = self.mailbox.exchange([chosen], self._flag(tensordict, self.sent_key))
        tensordict.set(self.action_key, came.held[0].view(*rows, *chosen.shape[1:]))
        if self.fresh_key:
            waiting = self.mailbox.since == self.mailbox.began
            tensordict.set(self.fresh_key, (came.fresh | waiting).view(rows))
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict
