"""A learnt belief on an environment that is not ours: VMAS navigation with observations 3 to 9 steps late.

    python examples/belief_head.py

Each agent gets the observations of its latest 12 steps, as far as they have arrived, and its latest actions.
The belief head learns to predict from them what the observation after each step will have been, once it has
arrived, and the policy reads what it makes of them. docs/extending.md explains the parts.
"""

import torch
from extending.predictive_mappo import PredictiveMappo, PredictiveMappoConfig
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import Composite, ReplayBuffer, Unbounded
from torchrl.envs import Compose, RenameTransform, StepCounter, Transform, TransformedEnv
from torchrl.envs.libs.vmas import VmasEnv

from damian import (
    ActionHistory,
    BackupdateStorage,
    LearningSetup,
    ObservationDelay,
    ObservationTimeline,
    Uniform,
    keys,
    set_seed,
)
from damian.learners.config import ModelConfig

WORLDS, STEPS, LATEST = 8, 16, 9


class Receiver(Transform):
    """What an agent observes: the observation that it holds and its age. The critic observes the former."""

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        held, age = next_tensordict[keys.RECEIVED], next_tensordict[keys.AGE] / LATEST
        next_tensordict[keys.OBSERVATION] = torch.cat([held, age], -1)
        next_tensordict[keys.GLOBAL_OBSERVATION] = held.clone()
        next_tensordict[keys.READY] = torch.ones_like(held[..., 0], dtype=torch.bool)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._step(tensordict, tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        shape = observation_spec[keys.RECEIVED].shape
        observation_spec[keys.OBSERVATION] = Unbounded(torch.Size((*shape[:-1], shape[-1] + 1)))
        observation_spec[keys.GLOBAL_OBSERVATION] = Unbounded(shape)
        observation_spec[keys.READY] = Unbounded(shape[:-1], dtype=torch.bool)
        return observation_spec


def late_navigation(n_worlds: int) -> TransformedEnv:
    """Three agents that navigate to their goals, each by late observations of its own."""
    late: list[Transform] = [
        RenameTransform([keys.OBSERVATION], [keys.MESSAGE]),
        ObservationDelay(Uniform(3, LATEST), keys.MESSAGE, keys.RECEIVED, age_key="age", delay_key="delay"),
        ObservationTimeline(12, keys.MESSAGE, delay_key="delay"),
        Receiver(),
        ActionHistory(LATEST, keys.ACTION, append_to=keys.OBSERVATION),
        StepCounter(100),
    ]
    return TransformedEnv(VmasEnv("navigation", num_envs=n_worlds, n_agents=3), Compose(*late))


def recompute(steps: TensorDictBase, messages: Tensor) -> dict[NestedKey, Tensor]:
    """What the critic would have observed after steps [T, B], had these observations arrived at once."""
    return {keys.next_key(keys.GLOBAL_OBSERVATION): messages}


def make_learner(env: TransformedEnv, config: PredictiveMappoConfig, n_worlds: int) -> PredictiveMappo:
    """The learner, with a replay buffer that back-updates what the critic observes."""
    setup = LearningSetup(
        model=ModelConfig(hidden=[64, 64]),
        worlds=n_worlds,
        shortest_period=STEPS,
        longest_period=STEPS,
        longest_delay=LATEST,
        backupdate=True,
        settle=True,  # learn from a step when all of its messages have arrived
    )
    config.check(setup)
    storage = BackupdateStorage(config.buffer_size(setup) or 0, recompute, LATEST)
    return config.make(env, setup, ReplayBuffer(storage=storage))


env = late_navigation(WORLDS)
set_seed(env, 0)
torch.manual_seed(0)
learner = make_learner(
    env, PredictiveMappoConfig(steps=STEPS, prediction_steps=20, prediction_batch=64), WORLDS
)
frames, errors = STEPS * WORLDS, []
collector = Collector(
    env,
    learner.actor,
    frames_per_batch=frames,
    total_frames=4 * frames,
    auto_register_policy_transforms=False,  # the actor is not recurrent
)
for batch in collector:
    errors.append(learner.learn(batch)["prediction_error"])
print(
    f"error of the predictions, of 1 for the mean: {errors[0]:.2f} at first, {errors[-1]:.2f} after 4 updates"
)
