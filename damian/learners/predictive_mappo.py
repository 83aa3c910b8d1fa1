"""MAPPO whose actor has a belief head: it also learns to predict what arrives later."""

from dataclasses import dataclass

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
from damian.learners.mappo import LOSS_KEYS, LOSSES, Mappo, MappoConfig, mappo_losses
from damian.learners.networks import ModelConfig


@LEARNERS.register("predictive_mappo")
@dataclass
class PredictiveMappoConfig(MappoConfig):
    """MAPPO with a learnt belief: attention over the messages that have arrived, trained by prediction."""

    name: str = "predictive_mappo"
    prediction_coeff: float = 1.0
    """Weight of the error of the predictions; 0: the encoder learns from the policy's gradient alone."""
    heads: int = 4
    """Number of questions that an actor asks about the messages it knows."""
    width: int = 32
    """Size of the embedding of a message."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.in_range("learner.prediction_coeff", self.prediction_coeff, 0.0)
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

    def make(self, env: EnvBase, setup: LearningSetup, buffer: ReplayBuffer | None) -> "PredictiveMappo":
        return PredictiveMappo(env, self, setup, buffer)

    def make_actor(self, env: EnvBase, model: ModelConfig) -> ProbabilisticActor:
        return make_belief_actor(env, model, self.heads, self.width)


class PredictiveMappo(Mappo):
    """MAPPO with one more term of the loss, the error of the predictions of its actor's belief head.

    The target of a step is the critic's observation after it, as the back-updating storage knows it by the
    time of learning. A step whose message has not arrived by then has no weight.
    """

    config: PredictiveMappoConfig
    loss_names = (*LOSSES, "loss_prediction")
    loss_keys: list[NestedKey] = [
        *LOSS_KEYS,
        keys.HISTORY,
        keys.PREDICTION_TARGET,
        keys.PREDICTION_WEIGHT,
    ]

    @torch.no_grad()
    def prepared(self, batch: TensorDictBase) -> TensorDictBase:
        arrived = arrived_by_now(batch[next_key(keys.DELAY)], self.setup.settle_steps)
        target, norm = batch[next_key(keys.GLOBAL_OBSERVATION)], belief_head(self.actor).norm
        if arrived.any():
            norm.update(target[arrived.squeeze(-1)])
        batch[keys.PREDICTION_TARGET] = norm.normalize(target)
        batch[keys.PREDICTION_WEIGHT] = arrived.to(target.dtype)
        return batch

    def _losses(self, entries: dict[NestedKey, Tensor], entropy_coeff: Tensor) -> tuple[Tensor, Tensor]:
        return mappo_losses(entries, self.actor, self.critic, self.config, entropy_coeff, self._prediction)

    def _prediction(self, steps: TensorDictBase) -> Tensor:
        """The error of the predictions, [], on steps that hold the encodings, [*]."""
        predicted = belief_head(self.actor).predict(steps[keys.ENCODING], steps[keys.ACTION])
        target, weight = steps[keys.PREDICTION_TARGET], steps[keys.PREDICTION_WEIGHT]
        return self.config.prediction_coeff * prediction_loss(predicted, target, weight)
