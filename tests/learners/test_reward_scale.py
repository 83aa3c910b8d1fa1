"""Learning does not depend on the scale of the rewards: normalised values of MAPPO, scaled rewards of SAC."""

import functools
from typing import Any

import pytest
import torch
from helpers import everything, learning
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.envs import StepCounter
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian import keys
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.learners.base import Learner
from damian.learners.mappo import Mappo, MappoConfig
from damian.learners.networks import ModelConfig
from damian.learners.recurrent import add_recurrent_state
from damian.learners.reward_scale import ReturnScale
from damian.learners.sac import Sac, SacConfig
from damian.replay.time_storage import TimeStorage
from damian.server.termination import EpisodeConfig

REWARD = keys.next_key(keys.REWARD)
MODELS: dict[str, dict[str, Any]] = {
    "own value": {},
    "shared value": {"shared_value": True},
    "recurrent": {"rnn": "gru"},
}


@functools.cache
def small_env(kind: str = "discrete", model: str = "own value") -> DelayedEnv:
    """An environment for all tests of a kind of action and a model."""
    env = make_env(everything("polynomial", kind=kind, episode=EpisodeConfig(max_steps=9)), 4, seed=1)
    env.append_transform(StepCounter())
    return env


def mappo(normalize: bool, model: str = "own value", **changed: Any) -> tuple[Mappo, DelayedEnv]:
    env = small_env(model=model)
    torch.manual_seed(3)
    config = MappoConfig(epochs=2, minibatches=2, normalize_value=normalize, **changed)
    learner = Mappo(env, config, learning(ModelConfig(hidden=[8], **MODELS[model])))
    add_recurrent_state(env, learner.actor)
    return learner, env


def sac(normalize: bool, kind: str) -> tuple[Sac, DelayedEnv]:
    env = small_env(kind)
    torch.manual_seed(3)
    config = SacConfig(updates=4, batch_size=32, warm_up=0, normalize_reward=normalize)
    buffer = ReplayBuffer(storage=TimeStorage(400))
    return Sac(env, config, learning(ModelConfig(hidden=[8])), buffer), env


def flights(
    env: DelayedEnv, actor: torch.nn.Module, n_batches: int = 2, steps: int = 12
) -> list[TensorDictBase]:
    """Consecutive batches [4, T] with episodes of 9 steps."""
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        flight = env.rollout(n_batches * steps, actor, break_when_any_done=False)
    return list(flight.split(steps, 1))


def learnt(learner: Learner, batches: list[TensorDictBase], scale: float) -> Tensor:
    """The weights of the actor after it has learnt from batches with scaled rewards."""
    torch.manual_seed(0)
    for batch in batches:
        scaled = batch.clone()
        scaled[REWARD] *= scale
        learner.learn(scaled)
    return torch.cat([weights.detach().flatten() for weights in learner.actor.parameters()])


def spread(make: Any, *arguments: Any) -> float:
    """By how much other scales of the rewards change the actor's weights, as a share of what it learns."""
    learner, env = make(*arguments)
    batches, begin = flights(env, learner.actor), learnt(learner, [], 1.0)
    end, *others = (learnt(make(*arguments)[0], batches, scale) for scale in (1.0, 0.01, 100.0))
    moved = (end - begin).abs().max().item()
    assert moved > 1e-3
    return max((other - end).abs().max().item() for other in others) / moved


@pytest.mark.sample(2)
@pytest.mark.parametrize(("model", "advantage"), [*((model, True) for model in MODELS), ("own value", False)])
def test_mappo_learns_the_same_from_rewards_of_any_scale_if_values_are_normalised(model, advantage):
    def make(normalize: bool) -> tuple[Mappo, DelayedEnv]:
        return mappo(normalize, model, normalize_advantage=advantage)

    assert spread(make, True) < 1e-2
    assert spread(make, False) > 5e-2


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_sac_learns_the_same_from_rewards_of_any_scale_if_rewards_are_normalised(kind):
    assert spread(sac, True, kind) < 1e-2
    assert spread(sac, False, kind) > 5e-2


def slow_returns(batches: list[TensorDictBase], gamma: float) -> list[float]:
    """Discounted sums of the rewards so far in each episode, world by world and step by step."""
    flight = torch.cat(batches, 1)
    durations = flight.get(("next", "duration"), torch.ones_like(flight["next", "done"]).long())
    found = []
    for world in range(flight.shape[0]):
        for agent in range(3):
            so_far = 0.0
            for t in range(flight.shape[1]):
                discount = gamma ** durations[world, t].item()
                so_far = discount * so_far + flight[REWARD][world, t, agent].item()
                found.append(so_far)
                if flight["next", "done"][world, t].item():
                    so_far = 0.0
    return found


@pytest.mark.parametrize("skips", [False, True])
def test_rewards_are_divided_by_the_root_mean_square_of_discounted_returns_over_all_batches(skips):
    learner, env = sac(False, "discrete")
    batches = flights(env, learner.actor, 6, 6)
    if skips:  # as with ``clock.skip``
        for i, batch in enumerate(batches):
            batch["next", "duration"] = (torch.arange(24).view(4, 6, 1) + i) % 4 + 1
    done = torch.cat([batch["next", "done"] for batch in batches], 1)
    assert done[:, 5:-1:6].any()  # between two batches
    assert done[:, 8].any()  # within a batch
    scale = ReturnScale(torch.zeros(4, 3, 1), 0.8)
    for batch in batches:
        before = batch.clone()
        scale.update(batch)
        assert (batch == before).all()
    expected = torch.tensor(slow_returns(batches, 0.8)).square().mean().sqrt()
    assert scale.value.item() == pytest.approx(expected.item(), rel=1e-4)
