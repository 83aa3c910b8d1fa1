"""Actions (paper, section 4.2): a distance and a heading that lead to a landing point of the UAV's own."""

import functools
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import shapely
import torch
from torch import Tensor
from tqdm import tqdm

from damian.common import checks, devices
from damian.common.tensors import gather_rows
from damian.world.airspace import Airspace, inside
from damian.world.nearest import LandingGrid

MAX_TABLE_BYTES = 4_000_000_000
"""Largest size of the tables of discrete actions [bytes]."""
_POINTS_AT_ONCE = 1024
"""Landing points whose actions are ranked together."""
_KEEPERS_AT_ONCE = 2**22
"""Landing points of contested worlds that are booked together, which bounds the memory: 32 MB."""
_COMPARED_AGENTS = 16
"""Most UAVs of a world whose choices are compared in pairs; with more, all are settled in turn."""
_FEW_AGENTS = 4
"""Most UAVs of a world that get landing points one after the other. With more, rounds in which all of them
ask at once are faster: they take 1.7 times as long with 3 UAVs, the same with 5, and 0.4 times with 8."""
_EDGES_AT_ONCE = 2**18
"""Pairs of target and polygon edge compared at once, which bounds the memory: a few arrays of 2 MB."""
_COMPARES_ALL = 1024
"""Up to so many landing points, all are compared where shapes may not depend on data. With more, a GPU waits
for the number of cells to search, in each step, because this costs less."""


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
        checks.types("actions", self)
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

    def table(self, dtype: torch.dtype = torch.float32) -> Tensor:
        """Discrete actions as (distance [m], heading [rad]), [A, 2]; the heading changes fastest."""
        headings = [math.radians(heading) for heading in self.headings]
        return torch.tensor([[d, h] for d in self.distances for h in headings], dtype=dtype)


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
        action = action.double().clamp(0, 1)
        move = displacement(action[..., 0] * self.max_distance, action[..., 1] * 2 * math.pi).flatten(0, 1)
        own, base = flat.flatten(), (flat - flat % self.airspace.max_points).flatten()
        target = gather_rows(self.airspace.exact_points.flatten(0, 1), own) + move
        regions = region.unsqueeze(-1).expand_as(flat).flatten()
        nearest = _nearest_inside(
            self.airspace.edges,
            [*self.airspace.grid],
            regions,
            target,
            own - base,
            self.n_candidates,
            self.airspace.max_points,
        )
        points = self.airspace.points.flatten(0, 1)
        offset = gather_rows(points, nearest + base.unsqueeze(-1)) - gather_rows(points, own).unsqueeze(1)
        distance = torch.linalg.vector_norm(offset, dim=-1)
        return Ranking(nearest, distance), torch.arange(len(own), device=own.device).view_as(flat)

    def goals(self) -> Tensor:
        """The two nearest landing points to which each discrete action may lead, [C, R*L, A] indices."""
        point = self.ranking.point.view(-1, self.config.n_actions, self.n_candidates)
        return point[..., :2].movedim(-1, 0).long().contiguous()

    def _rank_all(self) -> None:
        """Tabulate the candidates of every (landing point, action).

        ``ranking`` has R*L*A lists; ``distance`` [R*L, A] is that to the nearest candidate, 0 if the action
        holds, infinite if its target lies outside; ``hold`` [A] marks one action that holds (the first
        action, if no listed distance is 0).
        """
        table = self.config.table(torch.float64)
        self._require_fitting(self.airspace.points.shape[:2].numel() * len(table))
        # Adding 0 makes a negative 0 positive, so that actions which hold are equal, and are ranked once.
        move, alike = torch.unique(displacement(table[:, 0], table[:, 1]) + 0.0, dim=0, return_inverse=True)
        shape = (*self.airspace.points.shape[:2], len(table))
        self.distance = torch.zeros(shape)
        ranking = Ranking(
            torch.zeros(*shape, self.n_candidates, dtype=torch.int32), torch.zeros(*shape, self.n_candidates)
        )
        counts = self.airspace.n_points.tolist()
        with tqdm(total=sum(counts), desc="landing points", delay=1, leave=False) as bar:
            for region, count in enumerate(counts):
                for own in torch.arange(count).split(_POINTS_AT_ONCE):
                    ranked, within = self._rank_from(region, own, move)
                    for table_of_all, part in zip(ranking, ranked, strict=True):
                        table_of_all[region, own] = part[:, alike].to(table_of_all.dtype)
                    first = ranked.distance[..., 0].where(within, torch.inf)
                    self.distance[region, own] = first[:, alike]
                    bar.update(len(own))
        self.ranking = Ranking(*(each.flatten(0, 2) for each in ranking))
        self.distance = self.distance.flatten(0, 1)
        holds = table[:, 0] == 0
        self.can_hold = bool(holds.any())
        self.hold = torch.arange(len(table)) == int(holds.int().argmax())

    def _rank_from(self, region: int, own: Tensor, move: Tensor) -> tuple[Ranking, Tensor]:
        """Rank the landing points for flights within a region; a UAV holds if its target lies outside.

        Args:
            region: index of the region.
            own: landing points where UAVs stand, [P].
            move: displacements east and north, [A, 2] metres.

        Returns:
            Candidates, [P, A, K], and whether each target lies inside, [P, A].
        """
        polygon, points = self.airspace.regions[region].polygon, self.airspace.points[region]
        target = self.airspace.exact_points[region][own].unsqueeze(1) + move
        shapely.prepare(polygon)
        within = torch.as_tensor(shapely.contains_xy(polygon, *target.numpy().transpose(2, 0, 1)))
        nearest = own.view(-1, 1, 1).repeat(1, len(move), self.n_candidates)
        regions = torch.full((int(within.sum()),), region)
        found = self.airspace.grid.nearest(regions, target[within], self.n_candidates)
        nearest[within] = torch.where(found < 0, nearest[within], found)
        offset = gather_rows(points, nearest) - points[own, None, None]
        return Ranking(nearest, torch.linalg.vector_norm(offset, dim=-1)), within

    def _require_fitting(self, n_lists: int) -> None:
        """Refuse tables that are too large for the memory of a usual machine."""
        size = n_lists * (8 * self.n_candidates + 4)
        n_points, n_actions = n_lists // self.config.n_actions, self.config.n_actions
        checks.require(
            size <= MAX_TABLE_BYTES,
            "region.lattice_step",
            f"{n_points} landing points with {n_actions} actions and {self.n_candidates} candidates each",
            f"need {size / 1e9:.1f} GB, more than {MAX_TABLE_BYTES / 1e9:g} GB: raise region.lattice_step, "
            "set region.n_landing_points, list fewer actions.distances or actions.headings, lower "
            "region.pool, or take actions.kind=continuous",
        )

    def to(self, device: torch.device) -> "Candidates":
        """Move the tables to a device, in place."""
        self.airspace = self.airspace.to(device)
        if self.config.kind == "discrete":
            self.ranking = Ranking(*(table.to(device) for table in self.ranking))
            self.distance, self.hold = self.distance.to(device), self.hold.to(device)
        return self


@torch.library.custom_op("damian::nearest_inside", mutates_args=())
def _nearest_inside(
    edges: Tensor, grid: list[Tensor], region: Tensor, target: Tensor, own: Tensor, n: int, n_points: int
) -> Tensor:
    """Landing points nearest to targets, [M, n]; ``own`` instead of missing ones, and if a target is outside.

    This is a custom operator because the number of cells searched depends on the data, which a compiler
    cannot trace.

    Args:
        edges: of the polygons, [R, E, 4] metres.
        grid: the fields of the landing points' ``LandingGrid``.
        region: indices of the regions, [M].
        target: [M, 2] metres.
        own: landing points where the UAVs stand, [M].
        n: number of points.
        n_points: largest number of landing points of a region.
    """
    at_once = max(_EDGES_AT_ONCE // edges.shape[1], 1)
    parts = zip(region.split(at_once), target.split(at_once), strict=True)
    within = torch.cat([inside(edges.index_select(0, r), t) for r, t in parts])
    nearest = own.unsqueeze(-1).repeat(1, n)
    if n_points <= _COMPARES_ALL and not devices.data_dependent(own.device):
        found = LandingGrid(*grid).nearest_of_all(region, target, n, n_points)
        return torch.where(within.unsqueeze(-1) & (found >= 0), found, nearest)
    found = LandingGrid(*grid).nearest(region[within], target[within], n)
    nearest[within] = torch.where(found < 0, nearest[within], found)
    return nearest


@_nearest_inside.register_fake
def _(edges, grid, region, target, own, n, n_points):  # compilers need only the shape
    return own.new_empty(len(own), n)


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
        n_points: largest number of landing points of a region.

    Returns:
        Point that each UAV books, [B, N].
    """
    if torch.compiler.is_compiling() and row.shape[1] <= _FEW_AGENTS:
        return _assign_one_by_one(ranking, row, standing, reach)
    reached = gather_rows(ranking.distance[:, 0], row) <= reach
    choice = torch.where(reached, gather_rows(ranking.point[:, 0], row).long(), standing)
    departs = choice != standing
    # A UAV that is not alone in standing on a point or choosing it may have to yield.
    if row.shape[1] <= _COMPARED_AGENTS:
        claims = choice.unsqueeze(-1) == torch.cat([standing, choice], -1).unsqueeze(-2)
        contested = (departs & (claims.sum(-1, dtype=torch.int32) > 1)).any(-1)
    else:
        contested = departs.any(-1)
    return _settle(*ranking, row, standing, reach, choice, contested, n_points)


def _assign_one_by_one(ranking: Ranking, row: Tensor, standing: Tensor, reach: Tensor) -> Tensor:
    """The same for few UAVs, one after the other in all worlds; a graph makes a single kernel of it.

    A UAV takes the first of its candidates that it need not pass over. It passes over one in reach that
    another UAV stands on, or that an earlier one has booked; one out of reach, or its own, means holding.
    """
    point, distance = (gather_rows(table, row).unbind(-1) for table in ranking)
    reached = [each <= reach for each in distance]
    points = [torch.where(r, each.long(), standing).unbind(1) for r, each in zip(reached, point, strict=True)]
    stands, no = standing.unbind(1), torch.zeros_like(standing[:, 0], dtype=torch.bool)
    goals: list[Tensor] = []
    for i, own in enumerate(stands):
        goal, taken = own, [*stands[:i], *goals, *stands[i + 1 :]]
        for candidate in (each[i] for each in reversed(points)):
            clashes = (candidate == point for point in taken)
            refused = (candidate != own) & functools.reduce(torch.logical_or, clashes, no)
            goal = torch.where(refused, goal, candidate)
        goals.append(goal)
    return torch.stack(goals, 1)


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
    if not devices.data_dependent(choice.device):
        return _assign_serially(Ranking(point, distance), row, standing, reach)
    settled, worlds = choice.clone(), contested.nonzero().squeeze(-1)
    if not len(worlds):
        return settled
    ranking, at_once = Ranking(point, distance), max(_KEEPERS_AT_ONCE // n_points, 1)
    for part in worlds.split(at_once):
        rows, places, reaches, choices = (
            each.index_select(0, part) for each in (row, standing, reach, choice)
        )
        if row.shape[1] <= _FEW_AGENTS:
            goals = _assign_serially(ranking, rows, places, reaches)
        else:
            goals = _assign_in_order(ranking, rows, places, reaches, choices, n_points)
        settled.index_copy_(0, part, goals)
    return settled


@_settle.register_fake
def _(point, distance, row, standing, reach, choice, contested, n_points):  # compilers need only the shape
    return torch.empty_like(choice)


def _assign_in_order(
    ranking: Ranking, row: Tensor, standing: Tensor, reach: Tensor, choice: Tensor, n_points: int
) -> Tensor:
    """Serial assignment by deferred acceptance (Gale and Shapley, 1962); arguments as above.

    All UAVs ask for their best candidate. Each point keeps the earliest UAV that has asked for it; all others
    ask for their next one, and so does a UAV that has to yield to an earlier one. As the earliest UAV that
    ever asks for a free point keeps it, this ends with what the UAVs would take one after the other. A round
    costs as much as there are UAVs that ask.
    """
    points, distances, stands = ranking.point.flatten(), ranking.distance.flatten(), standing.flatten()
    asked, reach, booked = row.flatten() * ranking.point.shape[1], reach.flatten(), choice.flatten().clone()
    # A world's first point, and the UAV that each point keeps, as a flat number; those of a world count up in
    # index order.
    base = (torch.arange(len(row), device=row.device) * n_points).repeat_interleave(row.shape[1])
    nobody = row.numel()
    keeper = torch.full((len(row) * n_points,), nobody, device=row.device).index_fill_(0, base + stands, -1)
    asking = (booked != stands).nonzero().squeeze(-1)
    wanted = (base + booked).index_select(0, asking)
    while len(asking):
        before = keeper.index_select(0, wanted)
        keeper.scatter_reduce_(0, wanted, asking, "amin")
        kept = keeper.index_select(0, wanted) == asking
        displaced = before[kept]
        asking = torch.cat([asking[~kept], displaced[displaced < nobody]])
        candidate = asked.index_select(0, asking) + 1
        asked.index_copy_(0, asking, candidate)
        point, own = points.index_select(0, candidate).long(), stands.index_select(0, asking)
        flies = (distances.index_select(0, candidate) <= reach.index_select(0, asking)) & (point != own)
        booked.index_copy_(0, asking, torch.where(flies, point, own))
        asking, point = asking[flies], point[flies]
        wanted = base.index_select(0, asking) + point
    return booked.view_as(standing)


def _assign_serially(ranking: Ranking, row: Tensor, standing: Tensor, reach: Tensor) -> Tensor:
    """The same, one UAV after the other in all worlds, so that nothing depends on data."""
    reached = gather_rows(ranking.distance, row) <= reach.unsqueeze(-1)
    wishes = torch.where(reached, gather_rows(ranking.point, row).long(), standing.unsqueeze(-1))
    taken = torch.cat([standing, torch.full_like(standing, -1)], -1)
    for i in range(standing.shape[1]):
        own, wish = standing[:, i : i + 1], wishes[:, i]
        free = (wish == own) | (wish.unsqueeze(-1) != taken.unsqueeze(1)).all(-1)
        first = free.byte().argmax(-1, keepdim=True)  # of several, the first one
        taken[:, standing.shape[1] + i] = wish.gather(-1, first).squeeze(-1)
    return taken[:, standing.shape[1] :].clone()
