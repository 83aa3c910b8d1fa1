"""A transform that writes the return and the length of the episode so far."""

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded

from damian import keys
from damian.common.tensors import expand_mask
from damian.transforms.base import StatefulTransform
from damian.transforms.entries import Change, Entries, Memory, require_keys
from damian.transforms.order import KeyUsage


class EpisodeTotals(StatefulTransform):
    """Writes the sum of the rewards, and the number of steps, of each world's episode so far.

    The entries are those of TorchRL's ``RewardSum`` and ``StepCounter``, bit for bit; but a ``DelayedEnv``
    computes them in the same function as the rest of a step and the resets after it, which saves time.

    Args:
        reward_key: key of the rewards.
        return_key: key of their sum since the episode began, in the shape of the rewards.
        count_key: key of the number of steps since then, [B, 1] long.

    Examples:
        >>> env = make_env(ScenarioConfig(), num_worlds=64)
        >>> env.append_transform(EpisodeTotals())
        >>> env.rollout(50)["next", "agents", "episode_reward"]  # [64, 50, N, 1]
    """

    after_skipping = True
    per_world = True

    def __init__(
        self,
        reward_key: NestedKey = keys.REWARD,
        return_key: NestedKey = keys.EPISODE_REWARD,
        count_key: NestedKey = keys.STEP_COUNT,
    ) -> None:
        super().__init__(reward_key, [return_key, count_key])
        self.return_key, self.count_key = self.out_keys
        self.step_keys = self.in_keys

    @property
    def key_usage(self) -> KeyUsage:
        return KeyUsage(derives=[(self.in_keys[0], self.return_key)], creates=self.out_keys)

    @property
    def required_keys(self) -> list[NestedKey]:
        return []  # a reset outputs no reward

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        reward = self.env.full_reward_spec[self.in_keys[0]].zero()
        return {"total": reward, "count": torch.zeros(len(reward), 1, dtype=torch.long, device=reward.device)}

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        memory = {name: old.masked_fill(expand_mask(mask, old), 0) for name, old in memory.items()}
        return memory, self._outputs(memory)

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        memory = {"total": memory["total"] + entries[self.in_keys[0]], "count": memory["count"] + 1}
        return memory, self._outputs(memory)

    def _outputs(self, memory: Memory) -> Entries:
        # Copies, because others may change what a step outputs in place.
        return {self.return_key: memory["total"].clone(), self.count_key: memory["count"].clone()}

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        rewards, device = self.env.full_reward_spec, observation_spec.device
        require_keys(type(self).__name__, self.in_keys, rewards)
        reward = rewards[self.in_keys[0]]
        observation_spec[self.return_key] = Unbounded(reward.shape, dtype=reward.dtype, device=device)
        shape = torch.Size((*observation_spec.shape, 1))
        observation_spec[self.count_key] = Unbounded(shape, dtype=torch.long, device=device)
        return observation_spec
