"""The server node of SPEC 3, on what has arrived."""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from damian.server.features import Snapshot
from damian.server.server import Server
from damian.transforms.base import Change, Entries, Memory, Stateful, Uses

_AGENTS = ("observation", "global_observation", "reward")
_TASK = ("success", "done", "terminated", "truncated")


class ServerNode(Stateful):
    """Turns the messages that have arrived into observations, rewards and the status of the task.

    It writes what ``UavEnv`` writes by itself when nothing is delayed. After a reset the server holds the
    first message of every UAV, so that what the environment shows then stays as it is.

    Args:
        server: of the environment (``env.server``).
        message_key: the messages that the server holds, [B, N, M].
        drop: entries that nobody reads later; each costs time at every step.
        terms: write ``("agents", "reward_terms")`` too.
    """

    def __init__(
        self,
        server: Server,
        message_key: NestedKey = ("agents", "received"),
        *,
        drop: Sequence[NestedKey] = (),
        terms: bool = False,
    ) -> None:
        named = server.config.task.terms if terms else []
        made = [("agents", name) for name in _AGENTS] + [("agents", "reward_terms", name) for name in named]
        super().__init__([message_key], [*made, *_TASK])
        self.server, self.drop, self.terms = server, list(drop), terms
        self.own_key = ("agents", "message") if server.config.observation.own else None
        self.see_keys = [*self.in_keys, "source_over", *([self.own_key] if self.own_key else [])]

    @property
    def row_key(self) -> NestedKey:
        return "done"

    @property
    def uses(self) -> Uses:
        own = [self.own_key] if self.own_key else []
        return Uses(reads=[*self.in_keys, *own], makes=self.out_keys)

    def allocate(self, tensordict: TensorDictBase) -> Memory:
        messages = tensordict.get(self.in_keys[0])
        return {"elapsed": torch.zeros(self.rows.numel(), dtype=torch.long, device=messages.device)}

    def begin(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        return {"elapsed": memory["elapsed"].masked_fill(mask, 0)}, {}

    def see(self, memory: Memory, entries: Entries) -> Change:
        elapsed, received = memory["elapsed"] + 1, entries[self.in_keys[0]]
        steps = elapsed.view(self.rows)
        served = self.server.serve(Snapshot.unpack(received), steps, entries.get("source_over"))
        if self.own_key:
            known = self.server.informed(received, entries[self.own_key], steps)
            served = served._replace(observation=known)
        seen = [served.observation, served.global_observation, served.reward.unsqueeze(-1)]
        made: Entries = {("agents", name): value for name, value in zip(_AGENTS, seen, strict=True)}
        if self.terms:
            made |= {("agents", "reward_terms", name): term for name, term in served.terms.items()}
        return {"elapsed": elapsed}, made | served.status.entries()

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        for key in self.drop:
            del observation_spec[key]
        return observation_spec
