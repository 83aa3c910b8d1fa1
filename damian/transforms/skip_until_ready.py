"""Steps that last until there is something to decide."""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded

from damian.common import checks
from damian.transforms.base import Change, Entries, Memory, Stateful, wide


class FastForward(Stateful):
    """One step takes each world to the next moment at which some agent is ready, or its episode ends.

    That is as if it had been stepped until then with actions that nobody takes, bit for bit: what is shown
    is what is shown then, but rewards are sums over the steps that passed, k = 0, 1, ..., of gamma^k r_k, and
    ``duration`` says how many passed, [B, 1] long (0 after a reset). A learner that discounts the next value
    by gamma^duration learns in a semi-Markov decision process (Sutton, Precup and Singh, 1999).

    Only a ``DelayedEnv`` with a ``UavEnv`` can do so, as a world that has arrived must stand still, with all
    that is on its way, while others go on. It stands anywhere among damian's own transforms, which must come
    first; those of TorchRL that come later see only the long steps: ``StepCounter`` counts decisions.

    Args:
        gamma: in [0, 1]; with 1, returns are those of the short steps.
        reward_keys: what is summed up.
        ready_key: may the agent choose now, [B, N] bool.

    Raises:
        InputError: an impossible gamma.
    """

    def __init__(
        self,
        gamma: float = 1.0,
        reward_keys: Sequence[NestedKey] = (("agents", "reward"),),
        ready_key: NestedKey = ("agents", "ready"),
    ) -> None:
        checks.in_range("gamma", gamma, 0.0, 1.0)
        super().__init__(out_keys=["duration"])
        self.gamma, self.reward_keys, self.ready_key = gamma, list(reward_keys), ready_key
        self.see_keys = ["done"]

    @property
    def row_key(self) -> NestedKey:
        return "done"

    def begin(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        return memory, {"duration": torch.zeros_like(entries["done"], dtype=torch.long)}

    def see(self, memory: Memory, entries: Entries) -> Change:
        return memory, {"duration": torch.ones_like(entries["done"], dtype=torch.long)}

    def idle(self, shown: Entries) -> Tensor:
        """Worlds in which nobody can choose, and that go on, [B]."""
        ready, done = shown[self.ready_key], shown["done"]
        return ~(ready.flatten(1).any(-1) | done.view(-1))

    def longer(self, shown: Entries, after: Entries, moves: Tensor) -> Entries:
        """What is shown once the worlds of the mask [B] have made one more step."""
        passed = shown["duration"]
        weight = self.gamma**passed
        sums = {k: shown[k] + wide(weight.view(-1), after[k]) * after[k] for k in self.reward_keys}
        after = after | sums | {"duration": passed + 1}
        return {key: torch.where(wide(moves, new), new, shown[key]) for key, new in after.items()}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        raise RuntimeError(
            "FastForward works only in a DelayedEnv on a UavEnv, among the first transforms, all of them "
            "damian's, and with whole steps: neither '_step' nor 'next' may be among the entries"
        )

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        shape, device = torch.Size((*observation_spec.shape, 1)), observation_spec.device
        observation_spec["duration"] = Unbounded(shape, dtype=torch.long, device=device)
        return observation_spec
