"""Initial conditions (start points of the UAVs, walk of the source), drawn once so that a reset picks one."""

import copy
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from damian.common import checks
from damian.common.tensors import tree_map
from damian.world.airspace import Airspace, nearest_points
from damian.world.config import WorldConfig
from damian.world.regions.places import local_places
from damian.world.regions.region import Region
from damian.world.signal_source import SourceConfig, Walk, draw_walks

_MAX_KEYS = 2**24
"""Random numbers drawn at once, which bounds the memory: 128 MiB."""


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
        InputError: a given start position or source position lies outside the region, or two start
            positions lead to one landing point.
    """
    per_region = config.region.initial_conditions // len(airspace.regions)
    walks, starts = [], []
    for index, region in enumerate(airspace.regions):
        walks.append(draw_walks(region.polygon, _in_region(config.source, region), per_region, rng))
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


def _in_region(source: SourceConfig, region: Region) -> SourceConfig:
    """The source with its given position, if any, in local metres of a region."""
    if source.position is None:
        return source
    moved = copy.copy(source)  # not checked again
    moved.position = local_places("source.position", [source.position], region)[0].tolist()
    return moved


def _draw_starts(
    config: WorldConfig, airspace: Airspace, region: int, n: int, rng: np.random.Generator
) -> Tensor:
    """Landing points where the UAVs start, [n, N]: the given ones, one for all UAVs, or one for each."""
    if config.region.start_positions is not None:
        return _given_starts(config, airspace, region).expand(n, -1).clone()
    n_points = int(airspace.n_points[region])
    if config.region.start_together:
        return torch.as_tensor(rng.integers(n_points, size=(n, 1))).repeat(1, config.agents)
    at_once = max(_MAX_KEYS // n_points, 1)
    keys = (torch.as_tensor(rng.random((min(at_once, n - i), n_points))) for i in range(0, n, at_once))
    return torch.cat([part.topk(config.agents, dim=-1).indices for part in keys])


def _given_starts(config: WorldConfig, airspace: Airspace, region: int) -> Tensor:
    """Landing points nearest to the given start positions, [N]."""
    given, name = config.region.start_positions or [], airspace.regions[region].name
    local = torch.as_tensor(local_places("region.start_positions", given, airspace.regions[region]))
    regions = torch.full((len(local),), region)
    points = nearest_points(airspace.cells, airspace.exact_points, regions, local, 1).squeeze(-1)
    taken: dict[int, int] = {}
    for i, point in enumerate(points.tolist()):
        first = taken.setdefault(point, i)
        checks.require(
            first == i or config.region.start_together,
            "region.start_positions",
            f"{given[first]} and {given[i]}",
            f"lead to the same landing point of {name}: take places farther apart, or let UAVs share it by "
            "region.start_together=true",
        )
    return points
