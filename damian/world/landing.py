"""Actions (paper, section 4.2): a distance and a heading that lead to a landing point of the UAV's own."""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from damian.common import checks
from damian.common.tensors import gather_rows
from damian.world.airspace import Airspace, inside, nearest_points

MAX_PAIRS = 2_000_000_000
"""Most pairs of (landing point, action) and landing point compared at construction: about a minute."""


@dataclass
class ActionConfig:
    """The (distance, heading) actions of the UAVs (paper, section 4.2)."""

    kind: str = "discrete"
    """``discrete`` (every listed distance with every listed heading) or ``continuous``."""
    distances: list[float] = field(default_factory=lambda: [0.0, 50.0, 100.0, 150.0, 200.0])
    """Distances [m]; 0 holds the position. Continuous actions reach up to the largest distance."""
    headings: list[float] = field(
        default_factory=lambda: [-135.0, -90.0, -45.0, 0.0, 45.0, 90.0, 135.0, 180.0]
    )
    """Headings clockwise from north [deg]; only discrete actions use them."""
    mask: bool = True
    """Mask discrete actions without effect: target outside the region, battery too low, UAV in flight."""

    def __post_init__(self) -> None:
        checks.one_of("actions.kind", self.kind, ["discrete", "continuous"])
        checks.require(len(self.distances) > 0, "actions.distances", self.distances, "is empty")
        checks.require(len(self.headings) > 0, "actions.headings", self.headings, "is empty")
        for distance in self.distances:
            checks.in_range("actions.distances", distance, 0.0, unit="m")
        for heading in self.headings:
            checks.in_range("actions.headings", heading, -360.0, 360.0, unit="deg")
        checks.above("actions.distances (largest)", max(self.distances), 0.0, "m")
        for name in ("distances", "headings"):
            checks.distinct(f"actions.{name}", getattr(self, name))

    @property
    def n_actions(self) -> int:
        """Number of discrete actions."""
        return len(self.distances) * len(self.headings)

    def table(self) -> Tensor:
        """Discrete actions as (distance [m], heading [rad]), [A, 2]; the heading changes fastest."""
        headings = [math.radians(heading) for heading in self.headings]
        return torch.tensor([[d, h] for d in self.distances for h in headings])


def displacement(distance: Tensor, heading: Tensor) -> Tensor:
    """Displacement east and north, [*, 2] metres, of flights by distance [*] metres and heading [*] rad."""
    return distance.unsqueeze(-1) * torch.stack([heading.sin(), heading.cos()], -1)


class Ranking(NamedTuple):
    """M lists of K landing points, the preferred one first."""

    point: Tensor
    """Ids of the landing points within their region, [M, K]."""
    distance: Tensor
    """Distance from the point where the UAV stands [m], [M, K]."""


class Candidates:
    """Landing points to which an action may lead, nearest its target first.

    UAVs choose only while they stand on a landing point, so for discrete actions the candidates of every
    (landing point, action) are computed once. Among ``2N - 1`` candidates, one is always free: the other
    UAVs stand on at most ``N - 1`` points and have booked at most ``N - 1`` more.

    Args:
        airspace: regions and their landing points.
        config: settings of the actions.
        n_agents: number of UAVs N.

    Raises:
        InputError: too many landing points to rank for every discrete action.
    """

    def __init__(self, airspace: Airspace, config: ActionConfig, n_agents: int) -> None:
        self.airspace = airspace
        self.config = config
        self.n_candidates = min(2 * n_agents - 1, airspace.max_points)
        self.max_distance = max(config.distances)
        if config.kind == "discrete":
            self._rank_all()

    def rank(self, flat: Tensor, region: Tensor, action: Tensor) -> tuple[Ranking, Tensor]:
        """Rank the landing points to which the actions may lead.

        Args:
            flat: flat id of the landing point each UAV stands on, [B, N].
            region: index of each world's region, [B].
            action: discrete [B, N], or continuous [B, N, 2] in [0, 1].

        Returns:
            Candidates, and the row of each UAV among them, [B, N].
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
        """Candidates [*, K], and whether the target lies inside [*]; if it does not, the UAV holds."""
        target = standing + move
        valid = inside(edges, target)
        nearest = nearest_points(points, target, self.n_candidates)
        nearest = torch.where(valid.unsqueeze(-1), nearest, own.unsqueeze(-1))
        places = points.expand(*nearest.shape[:-1], *points.shape[-2:])
        places = places.gather(-2, nearest.unsqueeze(-1).expand(*nearest.shape, 2))
        distance = torch.linalg.vector_norm(places - standing.unsqueeze(-2), dim=-1)
        return Ranking(nearest, distance), valid

    def _rank_all(self) -> None:
        """Tabulate the candidates of every (landing point, action).

        ``ranking`` has R*L*A lists; ``distance`` [R*L, A] is that to the nearest candidate, 0 if the action
        holds, infinite if its target lies outside; ``hold`` [A] marks one action that holds (the first
        action, if no listed distance is 0).
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
        ranked_points, ranked_distances, first_distance = [], [], []
        for points, edges in zip(self.airspace.points, self.airspace.edges, strict=True):
            for own in torch.arange(len(points)).split(64):  # in parts, to bound the memory of the search
                standing = torch.nan_to_num(points[own], posinf=0.0).unsqueeze(1)
                own_point = own.unsqueeze(-1).expand(-1, len(table))
                ranking, within = self._rank(points, edges, standing, own_point, move)
                ranked_points.append(ranking.point.flatten(0, 1).to(torch.int32))
                ranked_distances.append(ranking.distance.flatten(0, 1))
                first_distance.append(ranking.distance[..., 0].where(within | holds, torch.inf))
        self.ranking = Ranking(torch.cat(ranked_points), torch.cat(ranked_distances))
        self.distance = torch.cat(first_distance)
        self.can_hold = bool(holds.any())
        self.hold = torch.arange(len(table)) == int(holds.int().argmax())

    def to(self, device: torch.device) -> "Candidates":
        """Move the tables to a device, in place."""
        self.airspace = self.airspace.to(device)
        if self.config.kind == "discrete":
            self.ranking = Ranking(*(table.to(device) for table in self.ranking))
            self.distance, self.hold = self.distance.to(device), self.hold.to(device)
        return self


def assign_landing_points(
    ranking: Ranking, row: Tensor, standing: Tensor, reach: Tensor, n_points: int
) -> Tensor:
    """Give every UAV its best free candidate, in index order, so that no two book one point.

    A point is free to a UAV if no other UAV stands on it or is bound for it; its own point always is. Most
    UAVs get their first candidate; only worlds in which two UAVs may conflict are assigned one by one.

    Args:
        ranking: candidates, as M lists of K.
        row: row of each UAV among these lists, [B, N].
        standing: point that each UAV stands on or is bound for, [B, N].
        reach: largest distance that the UAV may fly now [m], negative if it may not choose, [B, N]. A
            candidate farther away does not count, and stays free for other UAVs.
        n_points: number of landing points of a region; ids are below it.

    Returns:
        Point that each UAV books, [B, N].
    """
    reached = gather_rows(ranking.distance[:, 0], row) <= reach
    choice = torch.where(reached, gather_rows(ranking.point[:, 0], row).long(), standing)
    departs = choice != standing
    # Claims on each point: UAVs that stand there or choose it. A UAV that is not alone may have to yield.
    claims = standing.new_zeros(len(standing), n_points, dtype=torch.int16)
    claim = torch.cat([torch.ones_like(departs), departs], -1).to(claims.dtype)
    claims = claims.scatter_add(1, torch.cat([standing, choice], -1), claim)
    contested = (departs & (claims.gather(1, choice) > 1)).any(-1)
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
    """The choices [B, N], with those of the contested worlds [B] made again in index order.

    This is a custom operator because the number of contested worlds depends on the data, which a compiler
    cannot trace.
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
def _(point, distance, row, standing, reach, choice, contested, n_points):  # compilers need only the shape
    return torch.empty_like(choice)


def _assign_in_order(candidates: Tensor, standing: Tensor, n_points: int) -> Tensor:
    """Serial assignment as the fixed point of "take the best candidate that no earlier UAV has taken".

    After r rounds the choices of the first r + 1 UAVs are final, so N - 1 rounds suffice.

    Args:
        candidates: landing points, preferred first, [B, N, K].
        standing: point that each UAV stands on or is bound for, [B, N].
        n_points: number of landing points of a region; ids are below it.
    """
    n_agents = standing.shape[1]
    index = torch.arange(n_agents, device=standing.device).expand_as(standing)
    flat = candidates.flatten(1)
    own = candidates == standing.unsqueeze(-1)
    owner = index.new_full((len(index), n_points), n_agents).scatter_(1, standing, -1)

    def choose(owner: Tensor) -> Tensor:
        """Best candidate of each UAV that belongs to no earlier one; there always is one."""
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
