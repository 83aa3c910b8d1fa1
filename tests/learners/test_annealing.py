"""The entropy bonus of MAPPO, which may shrink over the environment steps of a run."""

import pytest
import torch
from helpers import everything, learning
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian.envs.uav_env import UavEnv
from damian.learners.mappo import Mappo, MappoConfig
from damian.learners.networks import ModelConfig


def annealing(frames: int, **settings: float) -> tuple[Mappo, TensorDictBase]:
    """A learner of a run of ``frames`` steps, and a batch of 4 worlds and 6 steps."""
    torch.manual_seed(0)
    env = UavEnv(everything(), 4)
    config = MappoConfig(epochs=1, minibatches=2, **settings)
    learner = Mappo(env, config, learning(ModelConfig(hidden=[8]), frames=frames))
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        return learner, env.rollout(6, learner.actor, break_when_any_done=False)


def weights_of_the_entropy(learner: Mappo, batch: TensorDictBase, n_updates: int) -> list[float]:
    numbers = [learner.learn(batch) for _ in range(n_updates)]
    return [-each["loss_entropy"] / each["entropy"] for each in numbers]


def test_the_entropy_bonus_goes_linearly_to_its_end_over_the_frames_of_the_run():
    learner, batch = annealing(96, entropy_coeff=0.4, entropy_coeff_end=0.0)
    assert weights_of_the_entropy(learner, batch, 6) == pytest.approx(
        [0.4, 0.3, 0.2, 0.1, 0.0, 0.0], abs=1e-6
    )
