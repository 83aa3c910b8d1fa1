"""Actions that are executed late."""

from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, MultiCategorical, MultiOneHot, OneHot, TensorSpec
from torchrl.envs import EnvBase

from damian.delays.delay_line import Mailbox
from damian.delays.laws import law_of
from damian.transforms.base import (
    Change,
    Entries,
    Memory,
    Stateful,
    Uses,
    as_rows,
    beside,
    from_rows,
    spec_rows,
)


class Actions(NamedTuple):
    """What a transform must know of an environment's actions."""

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
    return Actions(rows, as_rows(initial, rows), *_range(spec, rows))


def _range(spec: TensorSpec, rows: torch.Size) -> tuple[Tensor, Tensor]:
    """Least value and width of each number of an action."""
    if isinstance(spec, MultiCategorical):  # which is a Categorical, too
        width = spec.nvec.view(-1, spec.shape[-1])[0] - 1
        return torch.zeros_like(width), width.clamp(min=1).to(spec.device)
    if isinstance(spec, Categorical):
        width = torch.tensor(max(spec.n - 1, 1), device=spec.device)
        return torch.zeros_like(width), width
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
    def row_key(self) -> NestedKey:
        return self.action_key

    def find_rows(self, tensordict: TensorDictBase) -> torch.Size:
        return self.actions.rows

    @property
    def actions(self) -> Actions:
        """What the environment's specs say, read once."""
        if "_actions" not in self.__dict__:
            self.__dict__["_actions"] = actions_of(self.env, self.action_key, self.default)
        return self.__dict__["_actions"]

    def empty_cache(self) -> None:
        super().empty_cache()
        self.__dict__.pop("_actions", None)

    def reset_parent(self) -> None:
        super().reset_parent()
        self.__dict__.pop("_actions", None)


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
            [...] bool. The environment under the transform must read it itself: a ``SerialEnv`` passes it on,
            a ``ParallelEnv`` only what its specs name.
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
        self.sampler = law_of(delay).sampler(dt, loss)
        self.mailbox = Mailbox(self.sampler, "generation")
        self.sent_key, self.fresh_key = (beside(self.action_key, key) for key in (sent_key, fresh_key))
        self.act_keys = [self.action_key, *([self.sent_key] if self.sent_key else [])]

    @property
    def uses(self) -> Uses:
        return Uses(replaces=[self.action_key])

    def allocate(self, tensordict: TensorDictBase) -> Memory:
        initial = self.actions.initial
        streams = self.streams(tensordict.batch_size, initial.device)
        return self.mailbox.allocate([initial], streams) | {"initial": initial}

    def begin(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        memory, _ = self.mailbox.begin(memory, [memory["initial"]], mask)
        return memory, {}

    def act(self, memory: Memory, entries: Entries) -> Change:
        chosen = as_rows(entries[self.action_key], self.rows)
        sent = entries[self.sent_key].reshape(-1) if self.sent_key in entries else None
        memory, came = self.mailbox.exchange(memory, [chosen], sent)
        executed: Entries = {self.action_key: from_rows(came.held[0], self.rows)}
        if self.fresh_key:
            waiting = memory["since"] == memory["began"]
            executed[self.fresh_key] = (came.fresh | waiting).view(self.rows)
        return memory, executed
