"""MAPPO whose actor has a belief head: it also learns to predict what arrives later."""

import math
import os
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor

from damian import keys
from damian.common import checks
from damian.keys import next_key
from damian.learners.base import LEARNERS, LearningSetup
from damian.learners.belief_head import arrived_by_now, belief_head, make_belief_actor, prediction_loss
from damian.learners.mappo import LOSS_KEYS, Mappo, MappoConfig
from damian.learners.networks import ModelConfig


@LEARNERS.register("predictive_mappo")
@dataclass
class PredictiveMappoConfig(MappoConfig):
    """MAPPO with a learnt belief: attention over the messages that have arrived, trained by prediction."""

    name: str = "predictive_mappo"
    prediction_steps: int = 100
    """Steps of gradient descent on the predictions after each update."""
    prediction_batch: int = 400
    """Environment steps in each of them."""
    prediction_lr: float = 2e-3
    """Learning rate of the predictions."""
    prediction_buffer: int = 32_000
    """Environment steps, over all worlds, from which predictions are learnt."""
    heads: int = 4
    """Number of questions that an actor asks about the messages it knows."""
    width: int = 32
    """Size of the embedding of a message."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.in_range("learner.heads", self.heads, 1, 1024)
        checks.in_range("learner.width", self.width, 1, 16384)

    def check(self, setup: LearningSetup) -> None:
        super().check(setup)
        name, model = "learner=predictive_mappo", setup.model
        should = "needs backupdate=true and a message delay (delay.obs): what arrives late is what it predicts"
        checks.require(setup.backupdate, "learner", "predictive_mappo", should)
        for key, value, good in (
            ("model.rnn", model.rnn, not model.recurrent),
            ("model.skip", model.skip, not model.skip),
            ("model.hidden", model.hidden, bool(model.hidden)),
            ("recompute_actor", setup.recompute_actor, not setup.recompute_actor),
        ):
            checks.require(good, key, value, f"does not go with {name}, whose actor has an encoder of its own")

    def buffer_size(self, setup: LearningSetup) -> int | None:
        least = super().buffer_size(setup)
        return None if least is None else max(least, self.prediction_buffer // setup.worlds * setup.worlds)

    def make(self, env: EnvBase, setup: LearningSetup, buffer: ReplayBuffer | None) -> "PredictiveMappo":
        return PredictiveMappo(env, self, setup, buffer)

    def make_actor(self, env: EnvBase, model: ModelConfig) -> ProbabilisticActor:
        return make_belief_actor(env, model, self.heads, self.width)


class PredictiveMappo(Mappo):
    """MAPPO, and after each update steps of learning to predict, from steps of the replay buffer.

    The target of a step is the critic's observation after it, as the back-updating storage knows it by now. A
    step whose message has not arrived by now has no weight. What follows from an action does not depend on
    the policy, so that steps of earlier policies serve too.
    """

    config: PredictiveMappoConfig
    loss_keys = (*LOSS_KEYS, keys.ENCODING, keys.PREDICTION)

    def __init__(
        self, env: EnvBase, config: MappoConfig, setup: LearningSetup, buffer: ReplayBuffer | None = None
    ) -> None:
        super().__init__(env, config, setup, buffer)
        self.head = belief_head(self.actor)
        self.predictor_optimizer = torch.optim.Adam(self.head.parameters(), lr=config.prediction_lr, fused=True)

    def components(self) -> dict[str, Any]:
        """What a checkpoint stores: also the optimiser of the predictions."""
        return {**super().components(), "predictor_optimizer": self.predictor_optimizer}

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Make one update from a batch [B, T], then ``prediction_steps`` of learning to predict."""
        numbers = super().learn(batch.exclude(next_key(keys.HISTORY)))
        self._update_scale(batch.shape[1])
        errors = [self._prediction_step() for _ in range(self.config.prediction_steps)]
        return {**numbers, "prediction_error": torch.stack(errors).mean().item() if errors else math.nan}

    @torch.no_grad()
    def _update_scale(self, n_steps: int) -> None:
        """Add the latest ``n_steps`` steps to the running statistics of the targets."""
        since = torch.arange(n_steps, device=self.head.codes.device) + self.setup.settle_steps
        target, weight = self._targets(since.repeat_interleave(self.setup.worlds), torch.arange(self.setup.worlds).repeat(n_steps))
        if (weight > 0).any():
            self.head.norm.update(target[weight.squeeze(-1) > 0])

    def _prediction_step(self) -> Tensor:
        """One step of gradient descent on random steps of the replay buffer; the error, []."""
        storage, n = self.buffer.storage, self.config.prediction_batch
        held = len(storage.latest(10**9))
        device = self.head.codes.device
        since = torch.randint(held, (n,), device=device)
        world = torch.randint(self.setup.worlds, (n,), device=device)
        target, weight = self._targets(since, world)
        row = storage.latest(10**9).flip(0)[since]
        obs, hist, act = (storage.steps[key][row, world] for key in (keys.OBSERVATION, keys.HISTORY, keys.ACTION))
        predicted = self.head.predict(obs, hist, act)
        loss = prediction_loss(predicted, self.head.norm.normalize(target).unsqueeze(-2), weight.unsqueeze(-2))
        self.predictor_optimizer.zero_grad()
        loss.backward()
        self.predictor_optimizer.step()
        return loss.detach()

    def _targets(self, since: Tensor, world: Tensor):
        storage = self.buffer.storage
        order = storage.latest(10**9).flip(0)
        ok = since < len(order)
        row = order[since.clamp(max=len(order) - 1)]
        kk = [keys.GLOBAL_OBSERVATION] + [keys.REWARD] * int(os.environ.get("RW", "0"))
        target = torch.cat([storage.steps[next_key(k)][row, world] for k in kk], -1)
        arrived = arrived_by_now(storage.steps[next_key(keys.DELAY)][row, world], since) & ok.view(-1, 1, 1)
        return target, arrived.float()
