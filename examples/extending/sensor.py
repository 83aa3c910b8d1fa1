"""Your own sensor: the wind at each UAV, and a feature by which the UAVs feel it.

    cd examples/extending
    damian train "sensors=[{sensor: sensor:wind, strength: 3}]" \
        "observation.local_features=[spotted,sensor:wind_felt]"

A sensor reads the true state of B worlds with N UAVs, and every message carries its values; its
keyword-only arguments are parameters. A feature reads the values that the server holds by the name
of the sensor.
"""

import math

import torch
from torch import Tensor

from damian import feature, sensor
from damian.common import counter_rng
from damian.server.features import FeatureCache
from damian.world.simulation import Simulation
from damian.world.state import State

STRONGEST = 10.0
"""Wind speed that the feature shows as 1 [m/s]."""


@sensor(width=2)
def wind(state: State, world: Simulation, *, strength: float = 5.0, noise: float = 0.5) -> Tensor:
    """Wind at each UAV, east and north, with noise [m/s], [B, N, 2].

    The wind turns once in ten minutes, and once along a kilometre to the east.
    """
    time = (state.steps * world.dt).unsqueeze(-1)  # [B, 1]
    angle = 2 * math.pi * (time / 600 + state.position[..., 0] / 1000)
    direction = torch.stack([angle.sin(), angle.cos()], -1)
    # A number for each world, episode, step, UAV and value; a second sensor would add a counter of
    # its own.
    seed, episode, step = (
        number.view(-1, 1, 1) for number in (state.seed, state.episode, state.steps)
    )
    uav = torch.arange(angle.shape[-1], device=angle.device).unsqueeze(-1)
    value = torch.arange(2, device=angle.device)
    draw = counter_rng.uniform(seed, episode, step, uav, value)
    return strength * direction + noise * (2 * draw - 1)


@feature("local", [2], low=-1.0, high=1.0)
def wind_felt(cache: FeatureCache) -> Tensor:
    """Wind in the UAV's message, east and north, over the strongest one, [*, N, 2]."""
    return (cache.reading("wind") / STRONGEST).clamp(-1, 1)
