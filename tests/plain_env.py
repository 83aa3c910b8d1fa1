"""An environment whose actions, observations and rewards have any spec."""

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

GROUP = (3, 2)
"""Worlds, and agents in each of them."""


class Plain(EnvBase):
    """Three worlds of two agents, whose actions have no effect; the reward of step t is t.

    Args:
        action: spec of the actions, [3, 2, ...].
        observation: spec of the observations, [3, 2, ...], which are 0.
        reward: spec of the rewards, [3, 2, 1].
        ends: step that ends the episodes.
    """

    def __init__(
        self,
        action: TensorSpec | None = None,
        observation: TensorSpec | None = None,
        reward: TensorSpec | None = None,
        ends: int = 1000,
    ) -> None:
        super().__init__(batch_size=torch.Size(GROUP[:1]))
        self.ends = ends
        self.action_spec = self._agents(action=action or Unbounded((*GROUP, 1)))
        self.observation_spec = self._agents(observation=observation or Unbounded((*GROUP, 4)))
        self.reward_spec = self._agents(reward=reward or Unbounded((*GROUP, 1)))

    def _agents(self, **specs: TensorSpec) -> Composite:
        return Composite(agents=Composite(**specs, shape=GROUP), shape=self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        self.time = 0
        return self.observation_spec.zero()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.time += 1
        reward = self.full_reward_spec.zero()
        reward["agents", "reward"].fill_(self.time)
        done = torch.full((*self.batch_size, 1), self.time >= self.ends)
        return TensorDict({"done": done}, self.batch_size).update(self.observation_spec.zero()).update(reward)

    def _set_seed(self, seed: int | None) -> None:
        """The environment has no randomness."""
