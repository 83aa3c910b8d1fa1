"""Your own learner: REINFORCE with the batch's mean return as its baseline (Williams, 1992).

    cd examples/extending
    damian train learner=learner:ReinforceConfig learner.entropy=0.02 learner.steps=50

The settings are a dataclass derived from ``damian.LearnerConfig``; ``make`` builds the learner,
which has an ``actor``, learns from batches [B, T], and names the components that a checkpoint
stores.
"""

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.objectives.value.functional import reward2go

from damian import LearnerConfig, LearningSetup, keys
from damian.common import checks


@dataclass
class ReinforceConfig(LearnerConfig):
    """Settings of REINFORCE, beside the learning rate, the discount and the steps between two
    updates."""

    entropy: float = 0.01
    """Weight of the entropy bonus."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.in_range("learner.entropy", self.entropy, 0.0, 1.0)

    def make(self, env: EnvBase, setup: LearningSetup, buffer: ReplayBuffer | None) -> "Reinforce":
        return Reinforce(env, self, setup)


class Reinforce:
    """Increases the probability of actions that were followed by more reward than the batch's
    mean."""

    def __init__(self, env: EnvBase, config: ReinforceConfig, setup: LearningSetup) -> None:
        self.config = config
        self.actor = config.make_actor(env, setup.model)
        self.optimizer = torch.optim.Adam(self.actor.parameters(), lr=config.lr)

    def components(self) -> dict[str, Any]:
        return {"actor": self.actor, "optimizer": self.optimizer}

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        reward = batch[keys.next_key(keys.REWARD)]  # [B, T, N, 1]
        done = batch[keys.next_key(keys.DONE)].unsqueeze(-2).expand_as(reward)
        returns = reward2go(reward, done, self.config.gamma, time_dim=-3).squeeze(-1)
        ready = batch[keys.READY].float()  # a UAV in flight chooses nothing
        baseline = (returns * ready).sum() / ready.sum().clamp(min=1)
        chosen = self.actor.get_dist(batch)
        gain = (
            chosen.log_prob(batch[keys.ACTION]) * (returns - baseline)
            + self.config.entropy * chosen.entropy()
        )
        loss = -(gain * ready).sum() / ready.sum().clamp(min=1)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        return {"loss": loss.item(), "baseline": baseline.item()}
