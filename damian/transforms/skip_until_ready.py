"""A transform that merges the steps in which no agent can choose an action into one step."""

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
from damian.transforms.order import KeyUsage


class SkipUntilReady(StatefulTransform):
    """Steps each world until some agent can choose an action again, or the episode ends.

    The outputs equal, bit for bit, those of stepping the environment until then with actions that no agent
    executes. Only the reward is the sum of gamma^k r_k over the merged steps k = 0, 1, ..., and ``duration``,
    [B, 1] long, is the number of these steps (0 after a reset). A learner that discounts the next state value
    by gamma^duration learns in a semi-Markov decision process (Sutton, Precup and Singh, 1999).

    The transform works only in a ``DelayedEnv`` on a ``UavEnv``, where worlds with a ready agent can pause,
    with all of their messages in transit, while the others step on. Its place among damian's own transforms
    does not matter, but these must come before all others. Transforms of TorchRL that come later process only
    the merged steps: ``StepCounter`` counts decisions.

    Args:
        gamma: discount per merged step, in [0, 1]; with 1, returns are those of the single steps.
        reward_keys: keys of the rewards to sum.

    Raises:
        InputError: gamma is not in [0, 1].

    Examples:
        >>> clock = ClockConfig(skip=True)  # adds the transform
        >>> env = make_env(ScenarioConfig(motion=MotionConfig("polynomial"), clock=clock))
    """

    per_world = True

    def __init__(self, gamma: float = 1.0, reward_keys: Sequence[NestedKey] = (keys.REWARD,)) -> None:
        checks.in_range("gamma", gamma, 0.0, 1.0)
        super().__init__(out_keys=[keys.DURATION])
        self.gamma, self.reward_keys = gamma, list(reward_keys)
        self.step_keys = [keys.DONE]

    @property
    def key_usage(self) -> KeyUsage:
        return KeyUsage(creates=self.out_keys)

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        return memory, {keys.DURATION: torch.zeros_like(entries[keys.DONE], dtype=torch.long)}

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        return memory, {keys.DURATION: torch.ones_like(entries[keys.DONE], dtype=torch.long)}

    def skipped_worlds(self, entries: Entries) -> Tensor:
        """Worlds in which no agent is ready and the episode goes on, [B] bool."""
        ready, done = entries[keys.READY], entries[keys.DONE]
        return ~(ready.flatten(1).any(-1) | done.view(-1))

    def merge_steps(self, entries: Entries, later: Entries, stepped: Tensor) -> Entries:
        duration = entries[keys.DURATION]
        weight = (self.gamma**duration).view(-1)
        sums = {k: entries[k] + expand_mask(weight, later[k]) * later[k] for k in self.reward_keys}
        later = later | sums | {keys.DURATION: duration + 1}
        return {key: torch.where(expand_mask(stepped, new), new, entries[key]) for key, new in later.items()}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        raise RuntimeError(
            "SkipUntilReady works only in a DelayedEnv on a UavEnv, before all transforms that are not "
            "damian's, and only if all worlds step: the TensorDict must contain neither '_step' nor 'next'"
        )

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        shape, device = torch.Size((*observation_spec.shape, 1)), observation_spec.device
        observation_spec[keys.DURATION] = Unbounded(shape, dtype=torch.long, device=device)
        return observation_spec
