"""MAPPO: a critic that learns first, rewards of the team, and a learning rate that falls."""

import pytest
import torch
from helpers import learning
from tensordict import TensorDictBase

from damian import keys, make_env
from damian.envs.config import ScenarioConfig
from damian.envs.delayed_env import DelayedEnv
from damian.learners.mappo import Mappo, MappoConfig, add_advantages
from damian.models.config import MlpConfig
from damian.recipes.shared.learning import make_collector
from damian.server.rewards import RewardConfig
from damian.world.config import ActionConfig

STEPS = 6


def made(kind: str = "discrete", **changed) -> tuple[DelayedEnv, Mappo]:
    """An environment of two worlds, and a learner that makes one step of the optimiser an
    update."""
    actions = ActionConfig(kind=kind)
    reward = RewardConfig(coverage=1.0)
    env = make_env(ScenarioConfig(actions=actions, reward=reward), 2, seed=0)
    setup = learning(MlpConfig(hidden=[8]), worlds=2, frames=4 * 2 * STEPS)
    config = MappoConfig(epochs=1, minibatches=1, lr=0.1, **changed)
    return env, Mappo(env, config, setup)


def updates(env: DelayedEnv, learner: Mappo, n: int) -> list[TensorDictBase]:
    """Learn from n batches, which are returned."""
    collector = make_collector(env, learner.actor, 2 * STEPS)
    batches = []
    for batch, _ in zip(collector, range(n), strict=False):
        batches.append(batch.clone())
        learner.learn(batch)
    collector.shutdown()
    return batches


def weights(module) -> torch.Tensor:
    return torch.cat([each.detach().flatten().clone() for each in module.parameters()])


def test_the_critic_learns_first():
    env, learner = made(warm_up=2)
    before = weights(learner.actor), weights(learner.critic)
    updates(env, learner, 2)
    assert weights(learner.actor).equal(before[0])
    assert not weights(learner.critic).equal(before[1])
    updates(env, learner, 1)
    assert not weights(learner.actor).equal(before[0])


def test_the_learning_rate_and_the_entropy_bonus_fall_to_zero_at_the_end_of_the_run():
    env, learner = made(anneal=True)
    for share in (1.0, 0.75, 0.5, 0.25, 0.0):
        _, of_entropy, *_ = learner._weights_of_losses()
        updates(env, learner, 1)
        assert learner.optimizer.param_groups[0]["lr"] == pytest.approx(0.1 * share)
        assert of_entropy == pytest.approx(share)


def test_what_all_earn_is_what_each_learns_from():
    env, learner = made(normalize_advantage=False)
    (batch,) = updates(env, learner, 1)
    reward = batch["next"][keys.REWARD]
    assert (reward != reward[:, :, :1]).any()
    targets = {}
    for team in (0.0, 0.25, 1.0):
        copy = batch.clone()
        add_advantages(copy, learner.critic, MappoConfig(team=team))
        targets[team] = copy[keys.VALUE_TARGET]
    mean = batch.clone()
    mean["next"][keys.REWARD] = reward.mean(-2, keepdim=True).expand_as(reward).clone()
    add_advantages(mean, learner.critic, MappoConfig())
    torch.testing.assert_close(targets[1.0], mean[keys.VALUE_TARGET])
    mixed = torch.lerp(targets[0.0], targets[1.0], 0.25)
    torch.testing.assert_close(targets[0.25], mixed)
