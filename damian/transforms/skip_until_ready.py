"""Steps that last until some agent can choose again."""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded

from damian import keys
from damian.common import checks
from damian.common.tensors import expand_mask
from damian.transforms.base import StatefulTransform
from damian.transforms.entries import Change, Entries, Memory


class SkipUntilReady(StatefulTransform):
    """One step takes each world to the next instant at which some agent is ready, or its episode ends.

    The result is bit for bit that of stepping until then with actions that no agent executes, but rewards are
    sums over the skipped steps k = 0, 1, ... of gamma^k r_k, and ``duration`` counts these steps, [B, 1] long
    (0 after a reset). A learner that discounts the next value by gamma^duration learns in a semi-Markov
    decision process (Sutton, Precup and Singh, 1999).

    It works only in a ``DelayedEnv`` on a ``UavEnv``, where a world that is ready can stand still, with all
    of its messages in transit, while others step on. It may stand anywhere among damian's own transforms,
    which must come first. Transforms of TorchRL that come later see only the long steps: ``StepCounter``
    counts decisions.

    Args:
        gamma: discount within a step, in [0, 1]; with 1, returns are those of the short steps.
        reward_keys: rewards, which are summed.
        ready_key: may the agent choose now, [B, N] bool.

    Raises:
        InputError: an impossible gamma.
    """

    def __init__(
        self,
        gamma: float = 1.0,
        reward_keys: Sequence[NestedKey] = (keys.REWARD,),
        ready_key: NestedKey = keys.READY,
    ) -> None:
        checks.in_range("gamma", gamma, 0.0, 1.0)
        super().__init__(out_keys=[keys.DURATION])
        self.gamma, self.reward_keys, self.ready_key = gamma, list(reward_keys), ready_key
        self.step_keys = [keys.DONE]

    @property
    def row_key(self) -> NestedKey:
        return keys.DONE

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        return memory, {keys.DURATION: torch.zeros_like(entries[keys.DONE], dtype=torch.long)}

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        return memory, {keys.DURATION: torch.ones_like(entries[keys.DONE], dtype=torch.long)}

    def skipped_worlds(self, entries: Entries) -> Tensor:
        """Worlds in which no agent is ready and whose episode goes on, [B]."""
        ready, done = entries[self.ready_key], entries[keys.DONE]
        return ~(ready.flatten(1).any(-1) | done.view(-1))

    def merge_steps(self, entries: Entries, later: Entries, stepped: Tensor) -> Entries:
        duration = entries[keys.DURATION]
        weight = (self.gamma**duration).view(-1)
        sums = {k: entries[k] + expand_mask(weight, later[k]) * later[k] for k in self.reward_keys}
        later = later | sums | {keys.DURATION: duration + 1}
        return {key: torch.where(expand_mask(stepped, new), new, entries[key]) for key, new in later.items()}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        raise RuntimeError(
            "SkipUntilReady works only in a DelayedEnv on a UavEnv, among the first transforms, all of them "
            "damian's, and with whole steps: neither '_step' nor 'next' may be among the entries"
        )

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        shape, device = torch.Size((*observation_spec.shape, 1)), observation_spec.device
        observation_spec[keys.DURATION] = Unbounded(shape, dtype=torch.long, device=device)
        return observation_spec
