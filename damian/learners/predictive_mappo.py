"""MAPPO whose actor has a belief head: it also learns to predict what arrives later."""

from dataclasses import dataclass
from typing import Any, cast

import torch
from tensordict import TensorDictBase
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
from damian.replay.backupdate import BackupdateStorage

_NEEDS = "needs backupdate=true and a message delay (delay.obs): what arrives late is what it predicts"


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
    """Number of attention heads over the messages that an actor knows."""
    width: int = 32
    """Size of the embedding of a message."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("prediction_steps", "prediction_batch", "prediction_buffer"):
            checks.in_range(f"learner.{name}", getattr(self, name), 1, checks.STEPS)
        checks.above("learner.prediction_lr", self.prediction_lr, 0.0)
        checks.in_range("learner.prediction_lr", self.prediction_lr, 0.0, 1.0)
        checks.in_range("learner.heads", self.heads, 1, 1024)
        checks.in_range("learner.width", self.width, 1, 16384)

    def check(self, setup: LearningSetup) -> None:
        super().check(setup)
        name, model = "learner=predictive_mappo", setup.model
        checks.require(setup.backupdate, "learner", "predictive_mappo", _NEEDS)
        for key, value, good in (
            ("model.rnn", model.rnn, not model.recurrent),
            ("model.skip", model.skip, not model.skip),
            ("model.hidden", model.hidden, bool(model.hidden)),
            ("recompute_actor", setup.recompute_actor, not setup.recompute_actor),
        ):
            checks.require(
                good, key, value, f"does not go with {name}, whose actor has an encoder of its own"
            )

    def buffer_size(self, setup: LearningSetup) -> int | None:
        least = super().buffer_size(setup)
        return None if least is None else max(least, self.prediction_buffer // setup.worlds * setup.worlds)

    def make(self, env: EnvBase, setup: LearningSetup, buffer: ReplayBuffer | None) -> "PredictiveMappo":
        late = keys.DELAY in env.observation_spec.keys(True, True)  # rewards alone may be late
        checks.require(late, "learner", "predictive_mappo", _NEEDS)
        return PredictiveMappo(env, self, setup, buffer)

    def make_actor(self, env: EnvBase, model: ModelConfig) -> ProbabilisticActor:
        return make_belief_actor(env, model, self.heads, self.width)


class PredictiveMappo(Mappo):
    """MAPPO that after each update also learns to predict, from random steps of the replay buffer.

    The target of a step is the critic's observation after it, as the back-updating storage knows it by now. A
    step whose message has not arrived by now has no weight. What follows from an action does not depend on
    the policy, so that steps of earlier policies serve too.
    """

    config: PredictiveMappoConfig
    buffer: ReplayBuffer
    loss_keys = (*LOSS_KEYS, keys.ENCODING, keys.PREDICTION)

    def __init__(
        self, env: EnvBase, config: PredictiveMappoConfig, setup: LearningSetup, buffer: ReplayBuffer | None
    ) -> None:
        super().__init__(env, config, setup, buffer)
        self.head = belief_head(self.actor)
        self.head_optimizer = torch.optim.Adam(self.head.parameters(), lr=config.prediction_lr, fused=True)

    def components(self) -> dict[str, Any]:
        """What a checkpoint stores: also the optimiser of the belief head."""
        return {**super().components(), "head_optimizer": self.head_optimizer}

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Make one update of MAPPO from a batch [B, T], then ``prediction_steps`` of learning to predict.

        Returns:
            what ``Mappo.learn`` returns, and the mean ``prediction_error``: 1 for predictions that are no
            better than the mean.
        """
        # What is known after a step is what is known before the next one: it need not be stored twice.
        numbers = super().learn(batch.exclude(next_key(keys.HISTORY)))
        errors = [self.learn_prediction() for _ in range(self.config.prediction_steps)]
        return {**numbers, "prediction_error": torch.stack(errors).mean().item()}

    def learn_prediction(self) -> Tensor:
        """Make one step of gradient descent on random steps of the replay buffer; the error before it, []."""
        before, target, counts = self.sample()
        self.head.norm.update(target, counts)
        wanted = self.head.norm.normalize(target)
        error = prediction_loss(self.head.predict(*before), wanted.unsqueeze(-2), counts.unsqueeze(-2))
        self.head_optimizer.zero_grad()
        error.backward()
        self.head_optimizer.step()
        return error.detach()

    def sample(self) -> tuple[list[Tensor], Tensor, Tensor]:
        """Draw K stored steps: what predictions are made from, what came after, and what of it counts.

        Returns:
            observations, histories and actions of the steps, [K, N, ...]; the critic's observation after
            them, [K, N, G]; and whether it counts, [K, N, 1] bool: the UAV could choose, and its message has
            arrived by now.
        """
        storage = cast(BackupdateStorage, self.buffer.storage)
        rows, n_samples = storage.latest(), self.config.prediction_batch
        since = torch.randint(len(rows), (n_samples,), device=rows.device)
        index = rows[-1 - since], torch.randint(self.setup.worlds, (n_samples,), device=rows.device)
        after = (next_key(keys.GLOBAL_OBSERVATION), next_key(keys.DELAY))
        read = (keys.OBSERVATION, keys.HISTORY, keys.ACTION, keys.READY, *after)
        *before, ready, target, delay = (cast(Tensor, storage.steps[key])[index] for key in read)
        return before, target, arrived_by_now(delay, since) & ready.unsqueeze(-1)
