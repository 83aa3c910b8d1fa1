"""The server node as a transform, which uses only messages that have arrived (paper, section 3.4)."""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from damian import keys
from damian.common.tensors import expand_mask
from damian.server.server import Server
from damian.transforms.base import StatefulTransform
from damian.transforms.entries import Change, Entries, Memory
from damian.transforms.order import KeyUsage
from damian.world.coverage import KnownCoverage


class ServerNode(StatefulTransform):
    """Computes observations, rewards and the task's status from the messages that have arrived.

    The transform writes the entries that ``UavEnv`` writes itself when no message is delayed. After a reset
    the server holds the first message of every UAV, so the outputs of the environment's reset stay as they
    are. ``damian.make_env`` adds the transform where a scenario delays or loses messages.

    Args:
        server: server node that does the computations.
        message_key: key of the packed messages that the server holds, [B, N, M].
        dropped_keys: keys of entries to remove from the outputs, because nothing reads them later and each
            one costs time in every step.
        reward_terms: also write the weighted terms of the reward, ``("agents", "reward_terms")``.

    Examples:
        >>> env = UavEnv(scenario, num_worlds=64, extras=["message"], messages_only=True)
        >>> uplink = ObservationDelay(3, [("agents", "message")], [("agents", "received")])
        >>> env = TransformedEnv(env, Compose(uplink, ServerNode(env.server)))
    """

    per_world = True

    def __init__(
        self,
        server: Server,
        message_key: NestedKey = keys.RECEIVED,
        *,
        dropped_keys: Sequence[NestedKey] = (),
        reward_terms: bool = False,
    ) -> None:
        names = server.reward.terms if reward_terms else []
        created = [keys.OBSERVATION, keys.GLOBAL_OBSERVATION, keys.REWARD]
        created += [(*keys.REWARD_TERMS, name) for name in names]
        super().__init__([message_key], [*created, keys.SUCCESS, *keys.ENDS])
        self.server, self.dropped_keys, self.reward_terms = server, list(dropped_keys), reward_terms
        self.own_key = keys.MESSAGE if server.observation.own else None
        self.belief_keys = [keys.BELIEF, keys.OWN_BELIEF][: 1 + server.observation.own] if server.grid else []
        self.step_keys = [*self._read_keys, keys.SOURCE_OVER]

    @property
    def _read_keys(self) -> list[NestedKey]:
        """Keys of the entries that other transforms may delay or create."""
        return [*self.in_keys, *([self.own_key] if self.own_key else []), *self.belief_keys]

    @property
    def key_usage(self) -> KeyUsage:
        return KeyUsage(reads=self._read_keys, overwrites=self.out_keys)

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        rows = tensordict.get(self.in_keys[0])
        memory = {"elapsed": torch.zeros(self.rows.numel(), dtype=torch.long, device=rows.device)}
        if not self.server.remembers_coverage:
            return memory
        trail = self.server.messages(rows).trail
        return memory | {"trail": trail, "coverage": -torch.ones_like(trail[..., 0], dtype=rows.dtype)}

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        memory = memory | {"elapsed": memory["elapsed"].masked_fill(mask, 0)}
        if "coverage" in memory:
            memory["coverage"] = memory["coverage"].masked_fill(expand_mask(mask, memory["coverage"]), -1)
        return memory, {}

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        elapsed, received = memory["elapsed"] + 1, entries[self.in_keys[0]]
        steps, messages = elapsed.view(self.rows), self.server.messages(received)
        known = KnownCoverage(memory["trail"], memory["coverage"]) if "coverage" in memory else None
        outputs = self.server(messages, steps, entries.get(keys.SOURCE_OVER), known, entries.get(keys.BELIEF))
        if self.own_key:
            own = self.server.observe_with_timely_messages(
                received, entries[self.own_key], steps, belief=entries.get(keys.OWN_BELIEF)
            )
            outputs = outputs._replace(observation=own)
        written: Entries = {
            keys.OBSERVATION: outputs.observation,
            keys.GLOBAL_OBSERVATION: outputs.global_observation,
            keys.REWARD: outputs.reward.unsqueeze(-1),
        }
        if self.reward_terms:
            written |= {(*keys.REWARD_TERMS, name): term for name, term in outputs.terms.items()}
        memory = {"elapsed": elapsed}
        if outputs.coverage is not None:
            memory |= {"trail": outputs.coverage.trail, "coverage": outputs.coverage.share}
        return memory, written | outputs.status.entries()

    def after_idle_steps(self, memory: Memory, n_steps: int) -> Memory:
        return memory | {"elapsed": memory["elapsed"] + n_steps}
