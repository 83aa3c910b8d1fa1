"""Features of where the source is believed to be (``damian.server.belief``); beyond the paper's Table 2."""

import math

import torch
from torch import Tensor

from damian.common.tensors import gather_rows
from damian.server.belief import chance_of_staying, detection_chance, entropy, report_rows
from damian.server.feature_cache import FeatureCache
from damian.server.features import FEATURES, feature

RINGS = (1.0, 3.0)
"""Outer radii of the inner rings of ``belief_map``, in footprint radii; the outermost ring has no end."""
SECTORS = 8
"""Sectors of ``belief_map``; the first one is centred on north, the others follow clockwise."""


@FEATURES.register("belief_gain")
@feature("belief", width=None)
def _belief_gain(v: FeatureCache) -> Tensor:
    """Probability of detecting the source in the next step from where each discrete action leads, [*, N, A].

    Actions begin at the landing point that the UAV has reached last, are taken to be flown at once, and lead
    to the nearest landing point, or to the second nearest if another UAV is known to stand there.
    """
    if v.context.goals is None:
        raise ValueError("belief_gain needs the landing points to which actions lead")
    everyone, n_points = v.messages.trail[..., 0] % v.context.n_points, v.context.n_points
    standing = v.wanted(v.messages.trail[..., 0])
    rows = v.wanted(report_rows(v.grid, v.messages, torch.ones_like(v.messages.spotted)))
    stays = chance_of_staying(v.grid, v.belief, rows).unsqueeze(-1)
    chance = detection_chance(v.grid, v.belief, v.region)
    chance = chance.scatter(-1, everyone, -chance.gather(-1, everyone))  # negative where a UAV stands
    chance = chance.unsqueeze(-2).expand(*standing.shape, -1)
    chance = chance.scatter(-1, (standing % n_points).unsqueeze(-1), stays)
    goals = v.context.goals
    nearest, second = (chance.gather(-1, gather_rows(each, standing)) for each in (goals[0], goals[-1]))
    return torch.where(nearest < 0, second.abs(), nearest).clamp(max=1)


@FEATURES.register("belief_moments")
@feature("belief", width=4, low=-1.0)
def _belief_moments(v: FeatureCache) -> Tensor:
    """Way from the UAV to the mean place (east, north), spread, and entropy over its maximum, [*, N, 4].

    Lengths are over the largest vertex distance of the region, and at most 1.
    """
    belief, centres = v.belief, v.grid.centres
    *mean, square = (belief @ torch.cat([centres, centres.square().sum(-1, True)], -1)).unbind(-1)
    mean = torch.stack(mean, -1)
    variance = (square - mean.square().sum(-1)).clamp(min=0)
    offset = (mean.unsqueeze(-2) - v.wanted(v.messages.position)) / v.scale.unsqueeze(-1)
    unsure = entropy(belief) / math.log(max(belief.shape[-1], 2))
    shared = torch.stack([variance.sqrt() / v.context.scale, unsure], -1).unsqueeze(-2)
    return torch.cat([offset, shared.expand(*offset.shape[:-1], -1)], -1).clamp(-1, 1)


@FEATURES.register("belief_map")
@feature("belief", width=(len(RINGS) + 1) * SECTORS)
def _belief_map(v: FeatureCache) -> Tensor:
    """Probability that the source is in each part of three rings about the UAV, [*, N, 24].

    The parts are ``SECTORS`` sectors of each ring, the innermost ring first. A cell counts where its centre
    is.
    """
    position = v.wanted(v.messages.position)
    east, north = (v.grid.centres - position.unsqueeze(-2)).unbind(-1)  # [*, N, K]
    distance = torch.hypot(east, north) / v.context.radius
    ring = sum((distance > edge).long() for edge in RINGS)
    turn = torch.atan2(east, north) / (2 * math.pi)
    part = ring * SECTORS + (turn * SECTORS).round().long() % SECTORS
    share = v.belief.unsqueeze(-2).expand_as(east)
    bins = share.new_zeros(*part.shape[:-1], (len(RINGS) + 1) * SECTORS)
    return bins.scatter_add(-1, part, share).clamp(max=1)
