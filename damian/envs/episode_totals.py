"""A transform that sums up episodes, within the step of a ``DelayedEnv``."""

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from damian import keys
from damian.common.tensors import expand_mask
from damian.envs.nodes import WorldTransform
from damian.transforms.base import Change, Memory
from damian.transforms.entries import Entries, add_spec


class EpisodeTotals(WorldTransform):
    """Writes each episode's sum of rewards and number of steps (TorchRL's ``RewardSum``, ``StepCounter``)."""

    stage = "history"

    def __init__(self) -> None:
        super().__init__(keys.REWARD, [keys.EPISODE_REWARD, keys.STEP_COUNT])
        self.step_keys = self.in_keys

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        reward = self.env.full_reward_spec[keys.REWARD].zero()
        return {"total": reward, "count": torch.zeros(len(reward), 1, dtype=torch.long, device=reward.device)}

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        memory = {name: old.masked_fill(expand_mask(mask, old), 0) for name, old in memory.items()}
        return memory, self._outputs(memory)

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        memory = {"total": memory["total"] + entries[keys.REWARD], "count": memory["count"] + 1}
        return memory, self._outputs(memory)

    def _outputs(self, memory: Memory) -> Entries:
        # Copies, because others may change what a step outputs in place.
        return {keys.EPISODE_REWARD: memory["total"].clone(), keys.STEP_COUNT: memory["count"].clone()}

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        reward = self.env.full_reward_spec[keys.REWARD]
        add_spec(observation_spec, keys.EPISODE_REWARD, reward.shape, reward.dtype)
        add_spec(observation_spec, keys.STEP_COUNT, (*observation_spec.shape, 1), torch.long)
        return observation_spec
