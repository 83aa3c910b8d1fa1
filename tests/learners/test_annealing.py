"""The entropy bonus of MAPPO, which may shrink over the environment steps of a run."""

import pytest
import torch
from helpers import everything, learning
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian.common.errors import InputError
from damian.envs.uav_env import UavEnv
from damian.learners.mappo import Mappo, MappoConfig
from damian.learners.networks import ModelConfig
from damian.learners.schedule import LinearSchedule
from damian.recipes.shared.settings import TrainConfig
from damian.runs.checkpoint import restore


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


def test_the_entropy_bonus_is_constant_if_it_has_no_end():
    learner, batch = annealing(48, entropy_coeff=0.4)
    assert weights_of_the_entropy(learner, batch, 3) == pytest.approx([0.4] * 3)
    assert set(learner.components()) == {"actor", "critic", "optimizer"}  # as older checkpoints have


def test_a_learner_gets_the_frames_of_its_run():
    assert TrainConfig(frames=1234).learning_setup.frames == 1234


def test_a_resumed_learner_goes_on_with_the_same_weight(tmp_path):
    settings = {"entropy_coeff": 0.4, "entropy_coeff_end": 0.1}
    (whole, batch), (other, _) = annealing(100, **settings), annealing(100, **settings)
    whole.learn(batch)
    states = {name: part.state_dict() for name, part in whole.components().items()}
    restore(other.components(), states, tmp_path, "resume")
    assert other.entropy_coeff.value.equal(whole.entropy_coeff.value)
    assert other.entropy_coeff.value.item() == pytest.approx(0.4 - 0.3 * 24 / 100)
    older, _ = annealing(100)
    states = {name: part.state_dict() for name, part in older.components().items()}
    with pytest.raises(InputError, match="it has no entropy_coeff, only actor, critic, optimizer"):
        restore(other.components(), states, tmp_path, "resume")


def test_the_value_stays_one_tensor_so_that_nothing_is_compiled_again():
    schedule = LinearSchedule(1.0, 3.0, 4)
    value = schedule.value
    schedule.advance(1)
    assert value is schedule.value
    assert value.item() == 1.5


@pytest.mark.parametrize("end", [-0.1, float("nan"), 1e30])
def test_a_bad_end_is_refused_with_its_key(end):
    with pytest.raises(InputError, match=r"^learner\.entropy_coeff_end: "):
        MappoConfig(entropy_coeff_end=end)
