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
from damian.learners.belief_head import belief_head, ends_of_actions, make_belief_actor, prediction_loss
from damian.learners.mappo import LOSS_KEYS, Mappo, MappoConfig
from damian.learners.networks import ModelConfig
from damian.replay.backupdate import BackupdateStorage
from damian.replay.hindsight import arrived_by_now

_NEEDS = "needs backupdate=true and a message delay (delay.obs): what arrives late is what it predicts"
_CONSTANT = "needs a constant action delay (delay.act): it predicts what each action leads to, and when"


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
        checks.require(setup.action_delay is not None, "learner", "predictive_mappo", _CONSTANT)
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

    The target of a decision is the critic's observation when its action has ended (after the step in which it
    is executed; with real flight times after the landing), as the back-updating storage knows it by now. A
    decision whose last message has not arrived by now has no weight. What follows from an action does not
    depend on the policy, so that steps of earlier policies serve too.
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
        last = self.last_steps()
        errors = [self.learn_prediction(last) for _ in range(self.config.prediction_steps)]
        return {**numbers, "prediction_error": torch.stack(errors).mean().item()}

    def learn_prediction(self, last: Tensor) -> Tensor:
        """Make one step of gradient descent on random steps of the replay buffer; the error before it, [].

        Args:
            last: what ``last_steps`` returns.
        """
        before, target, counts = self.sample(last)
        self.head.norm.update(target, counts)
        wanted = self.head.norm.normalize(target)
        error = prediction_loss(self.head.predict(*before), wanted.unsqueeze(-2), counts.unsqueeze(-2))
        self.head_optimizer.zero_grad()
        error.backward()
        self.head_optimizer.step()
        return error.detach()

    @property
    def storage(self) -> BackupdateStorage:
        """The stored steps, from which predictions are learnt."""
        return cast(BackupdateStorage, self.buffer.storage)

    def last_steps(self) -> Tensor:
        """The last step of the action that each UAV has chosen, or carries on, in each stored step.

        Returns:
            index among the T stored steps in order of time, [T, B, N]; T if the action has not ended yet, or
            was never executed.
        """
        steps, rows = self.storage.steps, self.storage.latest()
        ready, reset = (cast(Tensor, steps[key])[rows] for key in (next_key(keys.READY), keys.RESET_AFTER))
        return ends_of_actions(ready, reset, cast(int, self.setup.action_delay))

    def sample(self, last: Tensor) -> tuple[list[Tensor], Tensor, Tensor]:
        """Draw K stored steps: what predictions are made from, what came after, and what of it counts.

        Args:
            last: what ``last_steps`` returns.

        Returns:
            observations, histories and actions of the steps, [K, N, ...]; the critic's observation when these
            actions had ended, [K, N, G]; and whether it counts, [K, N, 1] bool: the UAV could choose in this
            step and has completed its action, and its last message has arrived by now.
        """
        steps, rows, n_samples = self.storage.steps, self.storage.latest(), self.config.prediction_batch
        n_rows, device = len(rows), rows.device
        since = torch.randint(n_rows, (n_samples,), device=device)
        world = torch.randint(self.setup.worlds, (n_samples,), device=device)
        first = n_rows - 1 - since
        read = (keys.OBSERVATION, keys.HISTORY, keys.ACTION, keys.READY)
        *before, ready = (cast(Tensor, steps[key])[rows[first], world] for key in read)
        end = last[first, world]
        index = (
            rows[end.clamp(max=n_rows - 1)],
            world.unsqueeze(-1),
            torch.arange(end.shape[-1], device=device),
        )
        after = (keys.READY, keys.DELAY, keys.GLOBAL_OBSERVATION)
        completed, delay, target = (cast(Tensor, steps[next_key(key)])[index] for key in after)
        arrived = arrived_by_now(delay, n_rows - 1 - end)
        return before, target, arrived & (ready & completed).unsqueeze(-1)
