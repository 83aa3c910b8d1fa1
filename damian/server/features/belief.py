"""Features of where the sources are believed to be (``damian.server.belief``), beyond the paper's
Table 2."""

import math

import torch
from torch import Tensor

from damian.common.tensors import gather_rows
from damian.server.belief import (
    any_of,
    chance_of_staying,
    detection_chance,
    entropy,
    places,
    report_rows,
)
from damian.server.config import ObservationConfig
from damian.server.features.base import FeatureCache, feature
from damian.world.simulation import Simulation

BELIEF_RINGS = (1.0, 3.0)
"""Outer radii of the inner rings of ``belief_map``, in footprint radii; the outermost ring has no
end."""
RINGS = len(BELIEF_RINGS) + 1
"""Number of rings of ``belief_map``."""
BELIEF_SECTORS = 8
"""Sectors of ``belief_map``; the first one is centred on north, the others follow clockwise."""


def goals_of_actions(simulation: Simulation, _: ObservationConfig) -> Tensor:
    """The landing points to which discrete actions lead, as ``Candidates.goals``, [C, R*L, A]."""
    return simulation.candidates.goals()


@feature("belief", [None], name="belief_gain", tables=[goals_of_actions])
def belief_gain(v: FeatureCache) -> Tensor:
    """Probability of detecting any source next from where each discrete action leads, [*, N, A].

    Actions begin at the latest landing point, are taken to be flown at once, and lead to the
    nearest landing point, or to the second nearest if another UAV is known to stand there.
    """
    grid = v.grid
    level = v.context.level
    n_points = v.context.n_points
    points = v.messages.trail[..., 0]
    taken = points % n_points
    standing = v.wanted(points)
    by_uav = report_rows(grid, v.messages, level).movedim(-2, -1)
    rows = v.wanted(by_uav).movedim(-1, -2)
    stays = any_of(chance_of_staying(grid, v.belief, rows))
    chance = any_of(detection_chance(grid, v.belief, places(grid, v.region, level)))
    chance = chance.scatter(-1, taken, -chance.gather(-1, taken))  # negative where a UAV stands
    chance = chance.unsqueeze(-2).expand(*standing.shape, -1)
    own = (standing % n_points).unsqueeze(-1)
    chance = chance.scatter(-1, own, stays.unsqueeze(-1))
    goals = v.table(goals_of_actions)
    nearest = chance.gather(-1, gather_rows(goals[0], standing))
    second = chance.gather(-1, gather_rows(goals[-1], standing))
    return torch.where(nearest < 0, second.abs(), nearest).clamp(max=1)


@feature(
    "belief",
    [None, 4],
    low=-1.0,
    name="belief_moments",
    entries=["east", "north", "spread", "unsure"],
)
def _belief_moments(v: FeatureCache) -> Tensor:
    """Way to the mean place (east, north), spread (over the region's size), share of the largest
    entropy.

    These four of each source, [*, N, K, 4].
    """
    belief = v.belief
    centres = v.grid.centres
    squares = centres.square().sum(-1, True)
    *mean, square = (belief @ torch.cat([centres, squares], -1)).unbind(-1)
    mean = torch.stack(mean, -1)
    variance = square - mean.square().sum(-1)
    spread = variance.clamp(min=0).sqrt() / v.scale
    position = v.wanted(v.messages.position).unsqueeze(-2)
    offset = (mean.unsqueeze(-3) - position) / v.scale[..., None, None]  # [*, N, K, 2]
    unsure = entropy(belief) / math.log(max(belief.shape[-1], 2))
    shared = torch.stack([spread, unsure], -1).unsqueeze(-3)
    shared = shared.expand(*offset.shape[:-1], -1)
    return torch.cat([offset, shared], -1).clamp(-1, 1)


@feature("belief", [None, RINGS, BELIEF_SECTORS], name="belief_map")
def _belief_map(v: FeatureCache) -> Tensor:
    """Probability that each source is in each sector of three rings about the UAV,
    [*, N, K, 3, 8]."""
    position = v.wanted(v.messages.position)
    east, north = (v.grid.centres - position.unsqueeze(-2)).unbind(-1)  # [*, N, C]
    distance = torch.hypot(east, north) / v.radius
    ring = sum((distance > edge).long() for edge in BELIEF_RINGS)
    turn = torch.atan2(east, north) / (2 * math.pi)
    sector = (turn * BELIEF_SECTORS).round().long() % BELIEF_SECTORS
    part = ring * BELIEF_SECTORS + sector
    part = part.unsqueeze(-2)
    share = v.belief.unsqueeze(-3)
    share = share.expand(*position.shape[:-1], -1, -1)  # [*, N, K, C]
    bins = share.new_zeros(*share.shape[:-1], RINGS * BELIEF_SECTORS)
    found = bins.scatter_add(-1, part.expand_as(share), share)
    return found.clamp(max=1).unflatten(-1, (RINGS, BELIEF_SECTORS))
