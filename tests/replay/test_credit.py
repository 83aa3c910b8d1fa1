"""Skipping what lies between two decisions changes nothing of what is learnt from them."""

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
def flights():
    """One UAV's flights, every step and from decision to decision, each [B, T], and a critic."""
    scenario = everything("polynomial", agents=1, episode=EpisodeConfig(max_steps=30))
    skipped = replace(scenario, clock=ClockConfig(skip=True, skip_discount=GAMMA))
    torch.manual_seed(0)
    model = ModelConfig(hidden=[16])
    first = make_env(scenario, 16, seed=2)
    actor, critic = make_actor(first, model), make_critic(first, model)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        steps, jumps = (
            make_env(asked, 16, seed=2).rollout(95, actor, break_when_any_done=False)
            for asked in (scenario, skipped)
        )
    assert jumps["next", "duration"].float().mean() > 1.5
    return steps, jumps, critic


def decided(flight: TensorDictBase, worlds: int, values: torch.Tensor) -> list[list[float]]:
    """Values [B, T, ...] at the decisions of each world, in order."""
    ready = flight["agents", "ready"][..., 0]
    return [values[world][ready[world]].flatten(1).squeeze(-1).tolist() for world in range(worlds)]


def test_advantages_are_the_same(flights):
    steps, jumps, critic = flights
    config = MappoConfig(gamma=GAMMA, lmbda=0.7, normalize_advantage=False)
    found = []
    for flight in (steps, jumps):
        add_advantages(flight, critic, config)
        found.append(decided(flight, 16, flight["agents", "advantage"][..., 0, :]))
    ended = [steps["next", "done"][world].nonzero()[-1, 0].item() for world in range(16)]
    compared = 0
    for world, (all_, few) in enumerate(zip(*found, strict=True)):
        # Up to the last end that both have seen: what comes after is estimated from different last steps.
        n = int(steps["agents", "ready"][world, : ended[world] + 1].sum())
        assert all_[:n] == pytest.approx(few[:n], abs=1e-4)
        compared += n
    assert compared > 100


def test_transitions_are_the_same(flights):
    steps, jumps, _ = flights
    made = []
    for flight in (steps, jumps):
        by_time = flight.transpose(0, 1)
        ready, then = by_time["agents", "ready"], by_time["next", "agents", "ready"]
        ends = (by_time["next", key].squeeze(-1) for key in ("done", "terminated"))
        found = find_decisions(ready, then, *ends, 2)
        order = torch.arange(len(by_time))
        learnt = transitions(by_time, order, found, GAMMA, ["observation", "global_observation"])
        of_world = [learnt[found.world == world] for world in range(16)]
        made.append(of_world)
    compared = 0
    for all_, few in zip(*made, strict=True):
        n = min(len(all_), len(few))
        compared += n
        for key in ("steps_to_next_obs", ("next", "agents", "reward"), ("next", "agents", "observation")):
            assert torch.allclose(all_[:n][key].float(), few[:n][key].float(), atol=1e-5)
    assert compared > 100
