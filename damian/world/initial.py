"""Initial conditions (start points of the UAVs, walk of the source), drawn once so that a reset picks one."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from damian.common.errors import InputError
from damian.common.tensors import tree_map
from damian.world.airspace import Airspace, inside, nearest_points
from damian.world.config import WorldConfig
from damian.world.signal_source import Walk, draw_walks


class InitialConditions(NamedTuple):
    """Q initial conditions, the same number for each region."""

    region: Tensor
    """Index of the region, [Q]."""
    start: Tensor
    """Landing point of each UAV within its region, [Q, N]."""
    walk: Walk
    """Walk of the source over at most K stops, [Q, K]."""


def draw_initial_conditions(
    config: WorldConfig, airspace: Airspace, rng: np.random.Generator
) -> InitialConditions:
    """Draw the start points of the UAVs and the walks of the source, on the CPU.

    Raises:
        InputError: a given start position or source position lies outside the region.
    """
    per_region = config.region.initial_conditions // len(airspace.regions)
    walks, starts = [], []
    for index, region in enumerate(airspace.regions):
        walks.append(draw_walks(region.polygon, config.source, per_region, rng))
        starts.append(_draw_starts(config, airspace, index, per_region, rng))
    stops = max(walk.arrive.shape[1] for walk in walks)
    padded = [_pad(walk, stops) for walk in walks]
    region = torch.arange(len(airspace.regions)).repeat_interleave(per_region)
    walk = tree_map(lambda *parts: torch.cat(parts), *padded)
    return InitialConditions(region, torch.cat(starts), walk)


def _pad(walk: Walk, stops: int) -> Walk:
    """Pad walks to the given number of stops; the source never reaches the padded ones."""
    missing = stops - walk.arrive.shape[1]

    def repeat_last(field: Tensor) -> Tensor:
        last = field[:, -1:]
        return torch.cat([field, last.expand(-1, missing, *last.shape[2:])], 1)

    never = walk.arrive.new_full((len(walk.arrive), missing), torch.inf)
    return tree_map(repeat_last, walk)._replace(arrive=torch.cat([walk.arrive, never], 1))


def _draw_starts(
    config: WorldConfig, airspace: Airspace, region: int, n: int, rng: np.random.Generator
) -> Tensor:
    """Landing points where the UAVs start, [n, N]: the given ones, one for all UAVs, or one for each."""
    if config.region.start_positions is not None:
        place = torch.tensor(config.region.start_positions)
        within = inside(airspace.edges[region], place)
        if not within.all():
            outside = place[~within][0].tolist()
            raise InputError(f"region.start_positions: {outside} m lies outside the region")
        points = nearest_points(airspace.points[region], place, 1).squeeze(-1)
        return points.expand(n, -1).clone()
    n_points = int(airspace.n_points[region])
    if config.region.start_together:
        return torch.as_tensor(rng.integers(n_points, size=(n, 1))).repeat(1, config.agents)
    keys = torch.as_tensor(rng.random((n, n_points)))
    return keys.topk(config.agents, dim=-1).indices
