"""Actions that reach the environment late."""

from typing import Any

from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from damian.delays.delay_line import DelayLine
from damian.delays.laws import law_of
from damian.transforms.action_specs import ActionTransform
from damian.transforms.entries import Change, Entries, Memory, as_rows, from_rows, sibling_key
from damian.transforms.order import KeyUsage


class ActionDelay(ActionTransform):
    """The environment executes the action chosen some steps ago, and a default action until the first
    arrives.

    In a step at which no action arrives, the latest arrival is executed again. The chosen action stays in the
    data. With delay 0 the rollout is the same, bit for bit, as without the transform.

    Args:
        delay: a law, steps, or a time (``damian.delays.laws.law_of``); drawn for each world, agent and step.
        action_key: the action.
        default: executed until the first action arrives: a number, or values of an action's shape; the index,
            if actions are discrete. If not given, the legal value nearest to 0.
        loss: probability that an action never arrives.
        dt: length of a step [s], for laws in time.
        sent_key: flag that the policy sees: an action is sent only where it is true, [...] bool.
        valid_key: flag written for the environment: is this action executed for the first time (or is it the
            default), [...] bool. The environment itself must read it: a ``SerialEnv`` passes it on, a
            ``ParallelEnv`` only if its specs name it.
        seed: of the delays.

    A bare name for one of the last keys means an entry in the same TensorDict as the action.

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
        valid_key: NestedKey | None = None,
        seed: int | None = None,
    ) -> None:
        super().__init__(action_key, default, out_keys_inv=[action_key], seed=seed)
        self.sampler = law_of(delay).sampler(dt, loss)
        self.line = DelayLine(self.sampler, "generation")
        self.sent_key, self.valid_key = (sibling_key(self.action_key, key) for key in (sent_key, valid_key))
        self.action_keys = [self.action_key, *([self.sent_key] if self.sent_key else [])]

    @property
    def key_usage(self) -> KeyUsage:
        return KeyUsage(replaces=[self.action_key])

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        initial = self.actions.initial
        streams = self.streams(tensordict.batch_size, initial.device)
        return self.line.init_memory([initial], streams) | {"initial": initial}

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        memory, _ = self.line.reset(memory, [memory["initial"]], mask)
        return memory, {}

    def on_action(self, memory: Memory, entries: Entries) -> Change:
        chosen = as_rows(entries[self.action_key], self.rows)
        sent = entries[self.sent_key].reshape(-1) if self.sent_key in entries else None
        memory, delivery = self.line.step(memory, [chosen], sent)
        executed: Entries = {self.action_key: from_rows(delivery.held[0], self.rows)}
        if self.valid_key:
            default = memory["generated_at"] == memory["reset_at"]
            executed[self.valid_key] = (delivery.fresh | default).view(self.rows)
        return memory, executed
