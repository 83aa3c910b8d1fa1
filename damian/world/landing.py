"""What a UAV chooses: a distance and a heading, turned into a landing point that no other UAV has."""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from damian.common import checks
from damian.common.tensors import gather_rows
from damian.world.airspace import Airspace, inside, nearest_points

MAX_PAIRS = 2_000_000_000
"""Pairs of a landing point's action and a landing point that are compared at construction: a minute."""


@dataclass
class ActionConfig:
    """The (distance, heading) pairs of SPEC 2."""

    kind: str = "discrete"
    """``discrete`` (every listed distance with every listed heading) or ``continuous``."""
    distances: list[float] = field(default_factory=lambda: [0.0, 50.0, 100.0, 150.0, 200.0])
    """[m]; 0 holds the position. Continuous actions reach up to the largest."""
    headings: list[float] = field(
        default_factory=lambda: [-135.0, -90.0, -45.0, 0.0, 45.0, 90.0, 135.0, 180.0]
    )
    """Clockwise from north [deg]; discrete actions only."""
    mask: bool = True
    """Mask out discrete actions that would only hold (target outside, battery too low, in flight)."""

    def __post_init__(self) -> None:
        checks.one_of("actions.kind", self.kind, ["discrete", "continuous"])
        checks.require(len(self.distances) > 0, "actions.distances", self.distances, "is empty")
        checks.require(len(self.headings) > 0, "actions.headings", self.headings, "is empty")
        for distance in self.distances:
            checks.in_range("actions.distances", distance, 0.0, unit="m")
        for heading in self.headings:
            checks.in_range("actions.headings", heading, -360.0, 360.0, unit="deg")
        checks.above("actions.distances (largest)", max(self.distances), 0.0, "m")

    @property
    def n_actions(self) -> int:
        """Number of discrete actions."""
        return len(self.distances) * len(self.headings)

    def table(self) -> Tensor:
        """Discrete actions as (distance [m], heading [rad]), distance-major, [A, 2]."""
        headings = [math.radians(heading) for heading in self.headings]
        return torch.tensor([[d, h] for d in self.distances for h in headings])


def displacement(distance: Tensor, heading: Tensor) -> Tensor:
    """Metres east and north of a flight, [*, 2]."""
    return distance.unsqueeze(-1) * torch.stack([heading.sin(), heading.cos()], -1)


class Ranking(NamedTuple):
    """M lists of K landing points, the most preferred first."""

    point: Tensor
    """Ids within the region, [M, K]."""
    distance: Tensor
    """From where the UAV stands [m], [M, K]."""


class Candidates:
    """Landing points that an action may lead to, nearest its target first.

    UAVs choose only while they stand on a landing point, so for discrete actions the candidates of every
    (landing point, action) are computed once. ``2N - 1`` candidates always contain a free one: the
    others stand on ``N - 1`` points at most and have booked as many.
    """

    def __init__(self, airspace: Airspace, config: ActionConfig, n_agents: int) -> None:
        self.airspace = airspace
        self.config = config
        self.n_candidates = min(2 * n_agents - 1, airspace.max_points)
        self.max_distance = max(config.distances)
        if config.kind == "discrete":
            self._rank_all()

    def rank(self, flat: Tensor, region: Tensor, action: Tensor) -> tuple[Ranking, Tensor]:
        """Candidates, and each UAV's row among them [B, N].

        Args:
            flat: flat id of the landing point each UAV stands on, [B, N].
            region: [B].
            action: discrete [B, N], or continuous [B, N, 2] in [0, 1].
        """
        if self.config.kind == "discrete":
            return self.ranking, flat * self.config.n_actions + action
        distance = action[..., 0].clamp(0, 1) * self.max_distance
        heading = action[..., 1].clamp(0, 1) * 2 * math.pi
        ranking, _ = self._rank(
            self.airspace.points[region].unsqueeze(1),
            self.airspace.edges[region].unsqueeze(1),
            self.airspace.points.flatten(0, 1)[flat],
            flat % self.airspace.max_points,
            displacement(distance, heading),
        )
        row = torch.arange(flat.numel(), device=flat.device).view_as(flat)
        return Ranking(*(x.flatten(0, 1) for x in ranking)), row

    def _rank(
        self, points: Tensor, edges: Tensor, standing: Tensor, own: Tensor, move: Tensor
    ) -> tuple[Ranking, Tensor]:
        """Candidates [*, K] and whether the target lies inside, [*]. Outside the UAV holds (SPEC 2)."""
        target = standing + move
        valid = inside(edges, target)
        nearest = nearest_points(points, target, self.n_candidates)
        nearest = torch.where(valid.unsqueeze(-1), nearest, own.unsqueeze(-1))
        places = points.expand(*nearest.shape[:-1], *points.shape[-2:])
        places = places.gather(-2, nearest.unsqueeze(-1).expand(*nearest.shape, 2))
        distance = torch.linalg.vector_norm(places - standing.unsqueeze(-2), dim=-1)
        return Ranking(nearest, distance), valid

    def _rank_all(self) -> None:
        """Everything about every (landing point, action).

        ``ranking`` of R*L*A lists; ``distance`` [R*L, A] to the nearest candidate, 0 if the action holds,
        infinite if its target lies outside; ``hold`` [A] marks one action that holds (the first, if no
        listed distance is 0).
        """
        table = self.config.table()
        n_regions, n_points = self.airspace.points.shape[:2]
        checks.require(
            n_regions * n_points**2 * len(table) <= MAX_PAIRS,
            "region.lattice_step",
            f"{n_points} landing points",
            "are too many to rank for every action: raise region.lattice_step or set "
            "region.n_landing_points (or lower region.pool)",
        )
        move = displacement(table[:, 0], table[:, 1])
        holds = table[:, 0] == 0
        ranked, far, distance = [], [], []
        for points, edges in zip(self.airspace.points, self.airspace.edges, strict=True):
            for own in torch.arange(len(points)).split(64):  # bounds the memory of the search
                standing = torch.nan_to_num(points[own], posinf=0.0).unsqueeze(1)
                own_point = own.unsqueeze(-1).expand(-1, len(table))
                ranking, within = self._rank(points, edges, standing, own_point, move)
                ranked.append(ranking.point.flatten(0, 1).to(torch.int32))
                far.append(ranking.distance.flatten(0, 1))
                distance.append(ranking.distance[..., 0].where(within | holds, torch.inf))
        self.ranking = Ranking(torch.cat(ranked), torch.cat(far))
        self.distance = torch.cat(distance)
        self.can_hold = bool(holds.any())
        self.hold = torch.arange(len(table)) == int(holds.int().argmax())

    def to(self, device: torch.device) -> "Candidates":
        """Move the tables in place."""
        self.airspace = self.airspace.to(device)
        if self.config.kind == "discrete":
            self.ranking = Ranking(*(table.to(device) for table in self.ranking))
            self.distance, self.hold = self.distance.to(device), self.hold.to(device)
        return self


def assign_landing_points(
    ranking: Ranking, row: Tensor, standing: Tensor, reach: Tensor, n_points: int
) -> Tensor:
    """Give every UAV its best free candidate, in index order, so that no two book one point.

    A point is free if no other UAV stands on it or is bound for it (SPEC 2); a UAV's own always is. Most
    UAVs get their first candidate at once; only the worlds in which one does not are looked at again.

    Args:
        ranking: candidates.
        row: each UAV's list among them, [B, N].
        standing: point that each UAV stands on or is bound for, [B, N].
        reach: how far the UAV may fly now [m], negative if it may not choose; a candidate beyond it is
            none, so that it keeps nobody else from that point, [B, N].
        n_points: landing points of a region; ids are below it.

    Returns:
        Booked point of each UAV, [B, N].
    """
    reached = gather_rows(ranking.distance[:, 0], row) <= reach
    choice = torch.where(reached, gather_rows(ranking.point[:, 0], row).long(), standing)
    moves = choice != standing
    # How many stand on each point or want to move there: who finds more than itself may have to yield.
    claims = standing.new_zeros(len(standing), n_points, dtype=torch.int16)
    claim = torch.cat([torch.ones_like(moves), moves], -1).to(claims.dtype)
    claims = claims.scatter_add(1, torch.cat([standing, choice], -1), claim)
    contested = (moves & (claims.gather(1, choice) > 1)).any(-1)
    return _settle(*ranking, row, standing, reach, choice, contested, n_points)


@torch.library.custom_op("damian::settle", mutates_args=())
def _settle(
    point: Tensor,
    distance: Tensor,
    row: Tensor,
    standing: Tensor,
    reach: Tensor,
    choice: Tensor,
    contested: Tensor,
    n_points: int,
) -> Tensor:
    """The choices, made anew in index order in the contested worlds [B].

    An operator of its own, because how many these are depends on the data, which a compiler cannot trace.
    """
    settled = choice.clone()
    worlds = contested.nonzero().squeeze(-1)
    if len(worlds):
        row, standing, reach = (t.index_select(0, worlds) for t in (row, standing, reach))
        reached = gather_rows(distance, row) <= reach.unsqueeze(-1)
        candidates = torch.where(reached, gather_rows(point, row), standing.unsqueeze(-1))
        settled.index_copy_(0, worlds, _assign_in_order(candidates, standing, n_points))
    return settled


@_settle.register_fake
def _(point, distance, row, standing, reach, choice, contested, n_points):  # for compilers: its shape
    return torch.empty_like(choice)


def _assign_in_order(candidates: Tensor, standing: Tensor, n_points: int) -> Tensor:
    """Serial choice as the fixed point of "take the best candidate that no earlier UAV has taken".

    After r rounds the first r + 1 UAVs are settled, so that N - 1 rounds suffice; mostly one or two do.

    Args:
        candidates: [B, N, K].
        standing: [B, N].
        n_points: ids are below it.
    """
    n_agents = standing.shape[1]
    index = torch.arange(n_agents, device=standing.device).expand_as(standing)
    flat = candidates.flatten(1)
    own = candidates == standing.unsqueeze(-1)
    owner = index.new_full((len(index), n_points), n_agents).scatter_(1, standing, -1)

    def choose(owner: Tensor) -> Tensor:
        """Best candidate that belongs to no earlier UAV; there always is one."""
        owners = owner.gather(1, flat).view_as(candidates)
        allowed = own | (owners >= index.unsqueeze(-1))
        best = allowed.view(torch.uint8).argmax(-1, keepdim=True)
        return candidates.gather(-1, best).squeeze(-1)

    choice = choose(owner)
    for _ in range(n_agents - 1):
        settled = choose(owner.scatter_reduce(1, choice, index, "amin"))
        if torch.equal(settled, choice):
            break
        choice = settled
    return choice
