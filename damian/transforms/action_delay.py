"""A transform that delays actions (paper, section 3.3)."""

from collections.abc import Mapping, Sequence
from typing import Any

from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from damian.common.text_files import show
from damian.delays.laws import law_of, sampler_of
from damian.delays.line import DelayLine
from damian.transforms.action_specs import ActionTransform
from damian.transforms.context import ContextReader
from damian.transforms.entries import Change, Entries, Memory, as_rows, from_rows, sibling_key
from damian.transforms.order import KeyUsage


class ActionDelay(ActionTransform):
    """Delays actions: the environment executes the action that the policy chose some steps ago.

    Until the first action of an episode arrives, the environment executes a default action. In a step in
    which no newer action arrives, it executes the same action again. The TensorDict keeps the chosen action.
    With delay 0 the rollout is the same, bit for bit, as without the transform.

    Args:
        delay: steps (``3``), a time (``"3s"``), or a law of ``damian.delays.laws`` (``Uniform(3, 7)``).
            A delay is drawn for each world, each agent (under a nested key) and each step.
        action_key: key of the action.
        default: action that is executed until the first one arrives: a number, or values in the shape of an
            action; an index for discrete and one-hot actions. If not given, the legal value nearest to 0.
        loss: probability that an action never arrives.
        dt: length of a step [s], for delays given as times.
        sent_key: key of a flag in the policy's input, [...] bool: an action is sent only where it is true.
            If not given, every action is sent.
        valid_key: key of a flag that is written for the environment, [...] bool: true if the action is
            executed for the first time, or is the default. The environment must read it itself; a
            ``SerialEnv`` passes it on, a ``ParallelEnv`` only if its specs name it.
        context_keys: key of each entry that the law may read, by the name that the law gives it
            (``ContextSampler``). The policy's input and the outputs of a reset must have the entry.
        seed: seed of the delays until the environment is seeded; if there is none, it is drawn from torch's
            global generator at the first reset.
        gradients: let gradients flow through the executed actions (``StatefulTransform``).

    A bare name for one of the three keys above means an entry in the same TensorDict as the action.

    Raises:
        InputError: the delay is not valid, or its law reads what has no key; at the first use of the
            environment also: the default is no legal action, or the environment has no entry ``sent_key``.

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
        dt: float = 1.0,
        sent_key: NestedKey | None = None,
        valid_key: NestedKey | None = None,
        context_keys: Mapping[str, NestedKey] | None = None,
        seed: int | None = None,
        gradients: bool = False,
    ) -> None:
        super().__init__(action_key, default, out_keys_inv=[action_key], seed=seed, gradients=gradients)
        law = law_of(delay)
        self.sampler = sampler_of(law, dt, loss)
        self.draws = self.sampler.constant_delay is None
        self.same_draws_for_all_agents = self.sampler.same_draws_for_all_agents
        self.line = DelayLine(self.sampler, "generation", gradients)
        self.memory_setting = "ActionDelay: delay", show(delay)
        self.sent_key, self.valid_key = (sibling_key(self.action_key, key) for key in (sent_key, valid_key))
        self.contexts = ContextReader(law, self.sampler, context_keys, dt, self.action_key, before_step=True)
        sent_keys = [self.sent_key] if self.sent_key else []
        self.action_keys = [self.action_key, *sent_keys, *self.contexts.keys.values()]

    @property
    def key_usage(self) -> KeyUsage:
        flags = [self.valid_key] if self.valid_key else []
        return KeyUsage(replaces=[self.action_key], flags=flags)

    @property
    def row_dims(self) -> dict[str, int]:
        return self.line.row_dims(1)

    @property
    def memory_sizes(self) -> dict[str, int]:
        return {"longest": self.sampler.longest}

    @property
    def required_keys(self) -> Sequence[NestedKey]:
        return self.flag_to_require(self.sent_key)

    def memory_bytes(self, tensordict: TensorDictBase, n_rows: int) -> int:
        initial = self.actions.initial
        return self.line.n_bytes(n_rows, initial.nbytes // self.actions.rows.numel())

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        initial = self.action_rows(self.actions.initial)
        streams = self.streams(tensordict.batch_size, initial.device)
        memory = self.line.init_memory([initial], streams) | {"initial": initial}
        return self.contexts.init_memory(memory, tensordict, self.rows)

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        memory, _ = self.line.reset(memory, [memory["initial"]], mask)
        return memory, {}

    def on_action(self, memory: Memory, entries: Entries) -> Change:
        chosen = as_rows(entries[self.action_key], self.rows)
        sent = self.sending_rows(entries)
        context = self.contexts.read(memory, entries, sent, self.rows)
        memory, delivery = self.line.step(memory, [chosen], sent, context)
        executed: Entries = {self.action_key: from_rows(delivery.held[0], self.rows).clone()}
        if self.valid_key:
            default = memory["generated_at"] == memory["reset_at"]
            executed[self.valid_key] = (delivery.fresh | default).view(self.rows)
        return memory, executed
