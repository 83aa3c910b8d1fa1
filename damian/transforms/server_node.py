"""The server node of SPEC 3, on what has arrived."""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from damian.compiling import compiled
from damian.features import Snapshot
from damian.server import Judgement, Server
from damian.transforms.stateful import Order, Stateful, flag_rows

_TERMS = ("agents", "reward_terms")
_MADE = [
    ("agents", "observation"),
    ("agents", "global_observation"),
    ("agents", "reward"),
    _TERMS,
    "success",
    "done",
    "terminated",
    "truncated",
]


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

    elapsed: Tensor

    def __init__(
        self,
        server: Server,
        message_key: NestedKey = ("agents", "received"),
        *,
        drop: Sequence[NestedKey] = (),
        terms: bool = False,
    ) -> None:
        made = [key for key in _MADE if terms or key != _TERMS]
        super().__init__([message_key], made)
        self.server, self.drop, self.terms = server, list(drop), terms
        self.register_buffer("elapsed", None)
        self._advance = self._serve

    def compile(self) -> None:  # type: ignore[override]
        """Compile what a step computes."""
        self._advance = compiled(self._serve)

    @property
    def order(self) -> Order:
        return Order(reads=self.in_keys, makes=self.out_keys)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        mask = flag_rows(tensordict, "_reset", "done", tensordict_reset.batch_size)
        if self.elapsed is None or mask is None:
            n, device = tensordict_reset.batch_size.numel(), tensordict_reset.device
            self.elapsed = torch.zeros(n, dtype=torch.long, device=device)
        else:
            self.elapsed = self.elapsed.masked_fill(mask, 0)
        for key in self.drop:
            tensordict_reset.pop(key)
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self.elapsed is None:
            self._refuse()
        over = next_tensordict.get("source_over", None)
        over = torch.zeros_like(self.elapsed, dtype=torch.bool) if over is None else over.squeeze(-1)
        messages = next_tensordict.get(self.in_keys[0])
        self.elapsed, seen, judged = self._advance(self.elapsed, messages, over)
        for key in self.drop:
            next_tensordict.pop(key)
        agents = next_tensordict.get("agents")
        agents.set("observation", seen[0])
        agents.set("global_observation", seen[1])
        agents.set("reward", judged.reward.unsqueeze(-1))
        if self.terms:
            agents.set("reward_terms", TensorDict(judged.terms, agents.batch_size))
        ended = judged.status
        next_tensordict.set("success", ended.success.unsqueeze(-1))
        next_tensordict.set("terminated", ended.terminated.unsqueeze(-1))
        next_tensordict.set("truncated", ended.truncated.unsqueeze(-1))
        return next_tensordict.set("done", (ended.terminated | ended.truncated).unsqueeze(-1))

    def _serve(
        self, elapsed: Tensor, messages: Tensor, source_over: Tensor
    ) -> tuple[Tensor, tuple[Tensor, Tensor], Judgement]:
        """Steps of the episode [B], observations, and what they are worth."""
        elapsed, snapshot = elapsed + 1, Snapshot.unpack(messages)
        features = self.server.features(snapshot, elapsed)
        judged = self.server.judge(features, snapshot, elapsed, source_over)
        return elapsed, self.server.observations(features), judged

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        for key in self.drop:
            del observation_spec[key]
        return observation_spec
