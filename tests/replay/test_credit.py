"""Skipping the steps between two decisions does not change their advantages and transitions."""

from dataclasses import replace

import pytest
import torch
from helpers import everything
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian.envs.clocks import ClockConfig
from damian.envs.pipeline import make_env
from damian.learners.mappo import MappoConfig, add_advantages
from damian.learners.networks import ModelConfig, make_actor, make_critic
from damian.replay.smdp import find_decisions, transitions
from damian.server.termination import EpisodeConfig

GAMMA = 0.9


@pytest.fixture(scope="module")
def rollouts():
    """Rollouts of one UAV, with every simulation step and from decision to decision, [B, T], and a critic."""
    scenario = everything("polynomial", agents=1, episode=EpisodeConfig(max_steps=30))
    skipped = replace(scenario, clock=ClockConfig(skip=True, skip_discount=GAMMA))
    torch.manual_seed(0)
    model = ModelConfig(hidden=[16])
    env = make_env(scenario, 16, seed=2)
    actor, critic = make_actor(env, model), make_critic(env, model)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        every_step, skipping = (
            make_env(config, 16, seed=2).rollout(95, actor, break_when_any_done=False)
            for config in (scenario, skipped)
        )
    assert skipping["next", "duration"].float().mean() > 1.5
    return every_step, skipping, critic


def at_decisions(rollout: TensorDictBase, worlds: int, values: torch.Tensor) -> list[list[float]]:
    """Values [B, T, ...] at the decisions of each world, in order."""
    ready = rollout["agents", "ready"][..., 0]
    return [values[world][ready[world]].flatten(1).squeeze(-1).tolist() for world in range(worlds)]


def test_advantages_are_the_same(rollouts):
    every_step, skipping, critic = rollouts
    config = MappoConfig(gamma=GAMMA, lmbda=0.7, normalize_advantage=False)
    advantages = []
    for rollout in (every_step, skipping):
        add_advantages(rollout, critic, config)
        advantages.append(at_decisions(rollout, 16, rollout["agents", "advantage"][..., 0, :]))
    last_end = [every_step["next", "done"][world].nonzero()[-1, 0].item() for world in range(16)]
    n_compared = 0
    for world, (one, other) in enumerate(zip(*advantages, strict=True)):
        # Only up to the last end of an episode, because the two rollouts stop at different steps after it.
        n = int(every_step["agents", "ready"][world, : last_end[world] + 1].sum())
        assert one[:n] == pytest.approx(other[:n], abs=1e-4)
        n_compared += n
    assert n_compared > 100


def test_transitions_are_the_same(rollouts):
    every_step, skipping, _ = rollouts
    by_world = []
    for rollout in (every_step, skipping):
        steps = rollout.transpose(0, 1)
        ready, ready_next = steps["agents", "ready"], steps["next", "agents", "ready"]
        ends = (steps["next", key].squeeze(-1) for key in ("done", "terminated"))
        decisions = find_decisions(ready, ready_next, *ends, 2)
        order = torch.arange(len(steps))
        batch = transitions(steps, order, decisions, GAMMA, ["observation", "global_observation"])
        by_world.append([batch[decisions.world == world] for world in range(16)])
    n_compared = 0
    for one, other in zip(*by_world, strict=True):
        n = min(len(one), len(other))
        n_compared += n
        for key in ("steps_to_next_obs", ("next", "agents", "reward"), ("next", "agents", "observation")):
            assert torch.allclose(one[:n][key].float(), other[:n][key].float(), atol=1e-5)
    assert n_compared > 100
