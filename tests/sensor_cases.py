"""Sensors of the tests, the features that read them, and plain loops that compute the same
readings."""

import math

import torch
from torch import Tensor

from damian import UavEnv, feature, reward_term, sensor
from damian.common import counter_rng
from damian.server.features import FeatureCache
from damian.server.rewards import Counters
from damian.world.simulation import Simulation
from damian.world.state import State

SENSORS = [{"sensor": "sensor_cases:gust", "strength": 2.0}, "sensor_cases:gap"]
LOCAL = ["sensor_cases:gust_felt"]
GLOBAL = ["sensor_cases:widest_gap", "sensor_cases:gaps"]


@sensor(width=2)
def gust(state: State, world: Simulation, *, strength: float = 1.0) -> Tensor:
    """Random numbers up to ``strength`` of the world, episode, step and UAV, plus the time [s]."""
    seed, episode, step = (
        number.view(-1, 1, 1) for number in (state.seed, state.episode, state.steps)
    )
    uav = torch.arange(state.goal.shape[1]).unsqueeze(-1)
    value = torch.arange(2)
    return strength * counter_rng.uniform(seed, episode, step, uav, value) + step * world.dt


@sensor()
def gap(state: State, world: Simulation) -> Tensor:
    """Distance to the source [m]."""
    return torch.linalg.vector_norm(state.position[..., :2] - state.source[:, :1], dim=-1)


@feature("local", [2], low=-1.0, high=1.0)
def gust_felt(cache: FeatureCache) -> Tensor:
    """Sine of the gust."""
    return cache.reading("gust").sin()


@feature("global", high=1e4)
def widest_gap(cache: FeatureCache) -> Tensor:
    """Largest distance to the source, the same for every UAV [m]."""
    gaps = cache.reading("gap")
    return gaps.amax(-1, keepdim=True).expand_as(gaps)


@feature("global", [None], high=1e4)
def gaps(cache: FeatureCache) -> Tensor:
    """Distances of all UAVs to the source, the same for every UAV [m]."""
    every = cache.reading("gap")
    return every.unsqueeze(-2).expand(*every.shape, every.shape[-1])


@reward_term(reads=["sensor_cases:gust_felt", "sensor_cases:widest_gap"])
def calm(features: dict[str, Tensor], counters: Counters) -> Tensor:
    """Sum of a feature of two values, and of one whose range is not [0, 1]."""
    return features["sensor_cases:gust_felt"].sum(-1) + features["sensor_cases:widest_gap"]


def readings_of(env: UavEnv, strength: float = 2.0) -> Tensor:
    """What a UAV on the ground reads in the current state, by a loop over worlds and UAVs,
    [B, N, 3]."""
    state = env.state
    rows = []
    for b in range(len(state.seed)):
        rows.append([])
        counters = [state.seed[b], state.episode[b], state.steps[b]]
        for i in range(env.n_agents):
            draws = [
                counter_rng.uniform(*counters, torch.tensor(i), torch.tensor(k)).item()
                for k in (0, 1)
            ]
            gusts = [strength * draw + float(state.steps[b]) * env.simulation.dt for draw in draws]
            rows[b].append(
                [*gusts, math.dist(state.position[b, i, :2].tolist(), state.source[b, 0].tolist())]
            )
    return torch.tensor(rows)
