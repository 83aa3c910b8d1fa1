"""UAVs that compute their observations themselves, from the messages that have reached each of them."""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from damian import keys
from damian.server.server import Server
from damian.transforms.base import StatefulTransform
from damian.transforms.entries import Change, Entries, Memory
from damian.transforms.order import KeyUsage


class OnboardNode(StatefulTransform):
    """Computes each UAV's observation from the messages that have reached it, by the server's formulas.

    Rewards, the task's status and the critic's observation stay those of the server node. After a reset every
    UAV knows the first message of every other, so the outputs of the environment's reset stay as they are.
    What each UAV holds of each other is in ``("agents", "linked")``, as ``Channel`` writes it.
    ``damian.make_env`` adds the transform with ``links=matrix``.

    Args:
        server: server node whose features are computed.
        dropped_keys: keys of entries to remove from the outputs, because nothing reads them later.

    Examples:
        >>> env = UavEnv(scenario, num_worlds=64, extras=["message"])
        >>> channel = Channel(Uniform(1, 5), keys.MESSAGE, keys.LINKED, known_at_reset=True)
        >>> env = TransformedEnv(env, Compose(channel, OnboardNode(env.server)))
    """

    per_world = True

    def __init__(self, server: Server, *, dropped_keys: Sequence[NestedKey] = ()) -> None:
        super().__init__(keys.LINKED, keys.OBSERVATION)
        self.server, self.dropped_keys, self.step_keys = server, list(dropped_keys), self.in_keys

    @property
    def key_usage(self) -> KeyUsage:
        return KeyUsage(reads=self.in_keys, overwrites=self.out_keys)

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        device = tensordict.get(self.in_keys[0]).device
        return {"elapsed": torch.zeros(self.rows.numel(), dtype=torch.long, device=device)}

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        return {"elapsed": memory["elapsed"].masked_fill(mask, 0)}, {}

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        elapsed = memory["elapsed"] + 1
        known = self.server.messages(entries[self.in_keys[0]])
        observation = self.server.observe_each(known, elapsed.view(self.rows))
        return {"elapsed": elapsed}, {keys.OBSERVATION: observation}
