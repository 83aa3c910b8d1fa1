"""Whole rollouts against the slow twin, and the coverage against exact geometry."""

import math

import numpy as np
import pytest
import torch
import twin
from helpers import (
    KEEPS_GOING,
    act,
    both_kinds,
    clock,
    everything,
    fresh,
    random_actions,
    sent_messages,
)
from twin import GLOBAL, LOCAL

from damian import ScenarioConfig, UavEnv
from damian.server.config import BUILT_IN, EpisodeConfig, ObservationConfig, RewardConfig
from damian.world.config import RegionConfig, SourceConfig
from damian.world.landing import ActionConfig, action_table

TWIN_FEATURES = [name for name in GLOBAL if name != "coverage"]
OBSERVED = [*TWIN_FEATURES, *LOCAL]
"""Features in the order of the critic's observation."""


def twin_scenario(n_agents, kind, since):
    """Every reward term and feature except the coverage; uneven distances, so that no two points
    tie."""
    task = dict.fromkeys(BUILT_IN, 0.5) | {
        "coverage": 0.0,
        "served": 0.0,
        "individual": 0.8,
        "system": 1.5,
    }
    task |= {
        "drift": "printed" if since else "smooth",
        "desired_spotting": 0.7,
        "desired_distance": 0.4,
    }
    task |= {"desired_distance_not_spotting": 0.6, "desired_distance_spotting": 0.2}
    return ScenarioConfig(
        agents=n_agents,
        region=RegionConfig(min_area=15_000, max_area=60_000, pool=3, initial_conditions=24),
        source=SourceConfig(level_db=138.0),
        actions=ActionConfig(
            kind=kind,
            distances=[0.0, 33.3, 71.9, 118.4],
            headings=[-131.0, -77.7, -20.1, 11.3, 59.0, 123.4],
        ),
        observation=ObservationConfig(
            local_features=LOCAL, global_features=TWIN_FEATURES, time_scale=9.0
        ),
        reward=RewardConfig(**task, bonus=2.0, bonus_over_steps=True, penalty=0.5),
        episode=EpisodeConfig(5, since_detection=since, success_share=None if since else 0.5),
        clock=clock("2s"),
    )


def twins(env):
    """The twin's worlds, in the initial conditions of the environment's worlds."""
    airspace = env.simulation.airspace
    state = env.state
    worlds = []
    for b, region in enumerate(state.region.tolist()):
        points = airspace.points[region, : airspace.n_points[region]].tolist()
        first = state.goal[b] - region * airspace.max_points
        world = twin.World(
            polygon=airspace.regions[region].polygon,
            points=points,
            source=tuple(state.source[b, 0].tolist()),
            radius=10 ** ((138.0 - 105.0) / 20),
            scale=airspace.scale[region].item(),
            time_scale=9.0,
            dt=2.0,
            task=env.scenario.reward,
            episode=env.scenario.episode,
            uavs=[twin.Uav(tuple(points[p]), p) for p in first.tolist()],
        )
        world.begin()
        worlds.append(world)
    return worlds


def check_observation(world, observation):
    """Assert that the critic's observation [N, G] of one world equals the twin's."""
    features = world.observe()
    columns = [np.array(features[name]).reshape(len(world.uavs), -1) for name in OBSERVED]
    difference = np.abs(np.concatenate(columns, 1) - observation.numpy())
    # Bearings and drifts are angles over a full turn, so 0 equals 1.
    widths = np.cumsum([0, *[c.shape[1] for c in columns]])
    for name in ("source_bearing", "source_drift"):
        k = widths[OBSERVED.index(name)]
        difference[:, k] = np.minimum(difference[:, k], 1 - difference[:, k])
    assert difference.max() < 1e-4


@pytest.mark.sample(2)
@pytest.mark.parametrize("since", [False, True])
@both_kinds
@pytest.mark.parametrize("n_agents", [1, 2, 4])
def test_rollouts_equal_those_of_the_twin(n_agents, kind, since):
    env = UavEnv(twin_scenario(n_agents, kind, since), num_worlds=12, seed=n_agents)
    table = action_table(env.scenario.actions)
    compared = ended = spotted = 0
    for _ in range(3):
        output = env.reset()
        worlds = twins(env)
        for b, world in enumerate(worlds):
            check_observation(world, output["agents", "global_observation"][b])
        for _ in range(8):
            action = random_actions(env)
            moves = (
                table[action] if kind == "discrete" else action * torch.tensor([118.4, math.tau])
            )
            output = act(env, action)
            for b, world in enumerate(worlds):
                if any(world.ended):
                    continue
                rewards = world.step(moves[b].tolist())
                places = [list(uav.place) for uav in world.uavs]
                assert sent_messages(output).position[b].tolist() == places
                check_observation(world, output["agents", "global_observation"][b])
                ours = output["agents", "reward"][b, :, 0].tolist()
                assert ours == pytest.approx(rewards, abs=1e-4)
                flags = [output[k][b].item() for k in ("success", "terminated", "truncated")]
                assert tuple(flags) == world.ended
                spotted += sum(uav.spots for uav in world.uavs)
                ended += any(world.ended)
                compared += 1
    assert compared > 60
    assert ended > (0 if since else 20)
    assert spotted > 10


def test_the_coverage_of_the_last_landing_points_is_exact_within_one_percent():
    window = 3
    scenario = everything(
        observation=ObservationConfig(global_features=["coverage"], window=window),
        reward=RewardConfig(spotted=0.0, coverage=1.0),
        episode=KEEPS_GOING,
    )
    env = fresh(scenario, num_worlds=3)
    trails = env.state.position[..., :2].unsqueeze(2).expand(-1, -1, window, -1)
    for _ in range(5):
        output = act(env, random_actions(env))
        newest = env.state.position[..., :2].unsqueeze(2)
        trails = torch.cat([newest, trails[:, :, :-1]], 2)
        for b, region in enumerate(env.state.region.tolist()):
            polygon = env.simulation.airspace.regions[region].polygon
            expected = twin.exact_share(polygon, trails[b].double().numpy(), env.simulation.radius)
            assert output["agents", "reward"][b, :, 0].tolist() == pytest.approx(expected, abs=0.01)
