"""Actions (paper, section 4.2): a distance and a heading that lead to a landing point for one UAV
alone."""

import math
from typing import NamedTuple

import shapely
import torch
from torch import Tensor

from damian.common import devices
from damian.common.tensors import gather_rows
from damian.world.airspace import Airspace, Cells, inside, nearest_points
from damian.world.config import ActionConfig

BOOKING_CHUNK = 2**22
"""Landing points of all worlds in which UAVs book together, which bounds the memory: 32 MB."""
_FEW_AGENTS = 4
"""Most UAVs of a world that book one by one, in a fifth of the time of rounds for 3, in 5 times for
8."""
_POINTS_AT_ONCE = 1024
"""Landing points whose actions are ranked together, which bounds the memory."""
_EDGES_AT_ONCE = 2**18
"""Pairs of target and polygon edge compared at once, which bounds the memory: a few arrays of 2
MB."""


def action_table(actions: ActionConfig, dtype: torch.dtype = torch.float32) -> Tensor:
    """Discrete actions as (distance [m], heading [rad]), [A, 2]; the heading changes fastest."""
    headings = [math.radians(heading) for heading in actions.headings]
    return torch.tensor([[d, h] for d in actions.distances for h in headings], dtype=dtype)


def displacement(distance: Tensor, heading: Tensor) -> Tensor:
    """Displacement east and north, [*, 2] metres, of flights by distance [*] metres and heading [*]
    rad."""
    direction = torch.stack([heading.sin(), heading.cos()], -1)
    return distance.unsqueeze(-1) * direction


class Ranking(NamedTuple):
    """M lists of K landing points, the preferred one first."""

    point: Tensor
    """Ids of the landing points within their region, [M, K]."""
    distance: Tensor
    """Length of the way from the point where the UAV stands [m], [M, K]."""

    @classmethod
    def of_each(cls, point: Tensor, distance: Tensor) -> tuple["Ranking", Tensor]:
        """The ranking of own lists of the UAVs, [B, N, K] each, and the row of each UAV, [B, N]."""
        ranking = cls(point.flatten(0, 1), distance.flatten(0, 1))
        row = torch.arange(len(ranking.point), device=point.device)
        return ranking, row.view(point.shape[:2])


class Candidates:
    """Landing points to which an action of one of N UAVs may lead, nearest its target first.

    For discrete actions they are computed once. Among ``2N - 1`` candidates, one is always free:
    the other UAVs stand on at most ``N - 1`` points and have booked at most ``N - 1`` more.
    """

    def __init__(self, airspace: Airspace, config: ActionConfig, n_agents: int) -> None:
        self.airspace = airspace
        self.config = config
        self.n_candidates = min(2 * n_agents - 1, airspace.max_points)
        self.max_distance = max(config.distances)
        if config.kind == "discrete":
            self._rank_all()

    def rank(self, flat: Tensor, region: Tensor, action: Tensor) -> tuple[Ranking, Tensor]:
        """Rank the points to which actions from points ``flat`` may lead; and the row of each UAV,
        [B, N]."""
        if self.config.kind == "discrete":
            return self.ranking, flat * self.config.n_actions + action
        length, turns = action.double().clamp(0, 1).unbind(-1)
        move = displacement(length * self.max_distance, turns * 2 * math.pi)
        airspace = self.airspace
        origin = flat.flatten()
        own = origin % airspace.max_points
        base = origin - own
        exact_points = airspace.exact_points
        start = gather_rows(exact_points.flatten(0, 1), origin)
        target = start + move.flatten(0, 1)
        regions = region.unsqueeze(-1).expand_as(flat).flatten()
        where = regions, target, own, self.n_candidates
        nearest = _nearest_inside(airspace.edges, [*airspace.cells], exact_points, *where)
        goal = nearest + base.unsqueeze(-1)
        origins = origin.unsqueeze(1).expand_as(goal)
        ranking = Ranking(nearest, airspace.length(origins, goal))
        row = torch.arange(len(origin), device=origin.device)
        return ranking, row.view_as(flat)

    def goals(self) -> Tensor:
        """The two nearest landing points to which each discrete action may lead, [C, R*L, A]
        indices."""
        point = self.ranking.point.view(-1, self.config.n_actions, self.n_candidates)
        return point[..., :2].movedim(-1, 0).long().contiguous()

    def _rank_all(self) -> None:
        """Tabulate the candidates of every (landing point, action): R*L*A lists."""
        length, heading = action_table(self.config, torch.float64).unbind(-1)
        move = displacement(length, heading)
        n_actions = len(length)
        counts = self.airspace.n_points.tolist()
        max_points = self.airspace.max_points
        shape = (len(counts), max_points, n_actions)
        # To the nearest candidate; infinite if the target lies outside.
        shortest = torch.zeros(shape)
        distance = torch.zeros(*shape, self.n_candidates)
        point = torch.zeros_like(distance, dtype=torch.int32)
        for region, count in enumerate(counts):
            for own in torch.arange(count).split(_POINTS_AT_ONCE):
                ranked, within = self._rank_from(region, own, move)
                point[region, own] = ranked.point.int()
                distance[region, own] = ranked.distance
                nearest = ranked.distance[..., 0]
                shortest[region, own] = nearest.where(within, torch.inf)
        base = torch.arange(len(counts)) * max_points
        nearest = point[..., 0] + base.view(-1, 1, 1)
        self.nearest = nearest.flatten(0, 1)  # flat ids, [R*L, A]
        self.ranking = Ranking(point.flatten(0, 2), distance.flatten(0, 2))
        self.distance = shortest.flatten(0, 1)
        holds = length == 0
        self.can_hold = bool(holds.any())
        first = int(holds.int().argmax())
        self.hold = torch.arange(n_actions) == first  # the first one that holds, if any

    def _rank_from(self, region: int, own: Tensor, move: Tensor) -> tuple[Ranking, Tensor]:
        """Candidates [P, A, K] of moves from the points ``own`` [P], and whether these end inside
        [P, A]."""
        airspace = self.airspace
        exact_points = airspace.exact_points
        target = exact_points[region, own].unsqueeze(1) + move
        polygon = airspace.regions[region].polygon
        shapely.prepare(polygon)
        east, north = target.unbind(-1)
        within = torch.as_tensor(shapely.contains_xy(polygon, east.numpy(), north.numpy()))
        regions = torch.full((within.numel(),), region)
        each = own.repeat_interleave(len(move))
        where = regions, target.flatten(0, 1), each, within.flatten()
        nearest = _nearest_or_own(airspace.cells, exact_points, *where, self.n_candidates)
        nearest = nearest.view(*within.shape, -1)
        base = region * airspace.max_points
        origin = (own + base).view(-1, 1, 1)
        distance = airspace.length(origin.expand_as(nearest), nearest + base)
        return Ranking(nearest, distance), within


@torch.library.custom_op("damian::nearest_inside", mutates_args=())
def _nearest_inside(
    edges: Tensor,
    cells: list[Tensor],
    points: Tensor,
    region: Tensor,
    target: Tensor,
    own: Tensor,
    n: int,
) -> Tensor:
    """Landing points nearest to targets, [M, n]; ``own`` [M] instead of missing ones or outside."""
    at_once = max(_EDGES_AT_ONCE // edges.shape[1], 1)
    parts = zip(region.split(at_once), target.split(at_once), strict=True)
    within = [inside(edges.index_select(0, r), t) for r, t in parts]
    return _nearest_or_own(Cells(*cells), points, region, target, own, torch.cat(within), n)


@_nearest_inside.register_fake
def _(edges, cells, points, region, target, own, n):  # compilers need only the shape
    return own.new_empty(len(own), n)


def _nearest_or_own(
    cells: Cells,
    points: Tensor,
    region: Tensor,
    target: Tensor,
    own: Tensor,
    within: Tensor,
    n: int,
) -> Tensor:
    """As ``_nearest_inside``, where ``within`` [M] says which targets lie inside."""
    nearest = own.unsqueeze(-1).repeat(1, n)
    # Elsewhere, the number of targets inside is not known without waiting.
    if devices.data_dependent(own.device):
        found = nearest_points(cells, points, region[within], target[within], n)
        nearest[within] = torch.where(found < 0, nearest[within], found)
        return nearest
    found = nearest_points(cells, points, region, target, n)
    replaces = within.unsqueeze(-1) & (found >= 0)
    return torch.where(replaces, found, nearest)


def assign_landing_points(
    ranking: Ranking, row: Tensor, standing: Tensor, reach: Tensor, n_points: int
) -> Tensor:
    """Give every UAV its best free candidate, in index order, so that no two book one point,
    [B, N].

    A point is free to a UAV if no other UAV stands on it or flies to it (``standing`` [B, N]); its
    own point always is. ``row`` [B, N] is that of each UAV in the ranking, ``reach`` [B, N] the
    largest distance that
    it may fly [m], negative if it may not choose: candidates farther away stay free for other UAVs.
    """
    if row.shape[1] <= _FEW_AGENTS or not devices.data_dependent(row.device):
        return _assign_one_by_one(ranking, row, standing, reach)
    return _assign_in_rounds(*ranking, row, standing, reach, n_points)


def _assign_one_by_one(ranking: Ranking, row: Tensor, standing: Tensor, reach: Tensor) -> Tensor:
    """Each UAV takes its first free candidate, one after the other in all worlds."""
    reached = gather_rows(ranking.distance, row) <= reach.unsqueeze(-1)
    points = gather_rows(ranking.point, row).long()
    wishes = torch.where(reached, points, standing.unsqueeze(-1))
    taken = standing.t().unsqueeze(-1)
    goals = []
    for own, wish in zip(standing.split(1, 1), wishes.unbind(1), strict=True):
        clash = (wish == taken).any(0)
        free = (wish == own) | ~clash
        first = free.byte().argmax(-1, keepdim=True)
        goal = wish.gather(-1, first)
        goals.append(goal)
        taken = torch.cat([taken, goal.unsqueeze(0)])
    return torch.cat(goals, 1)


@torch.library.custom_op("damian::assign_in_rounds", mutates_args=())
def _assign_in_rounds(
    point: Tensor, distance: Tensor, row: Tensor, standing: Tensor, reach: Tensor, n_points: int
) -> Tensor:
    """The same by deferred acceptance (Gale and Shapley, 1962), as a custom operator.

    Each point keeps the earliest UAV that has asked for it; all others ask for their next one.
    """
    at_once = max(BOOKING_CHUNK // n_points, 1)
    points = point.flatten()
    distances = distance.flatten()
    first = row * point.shape[1]
    parts = zip(*(each.split(at_once) for each in (first, standing, reach)), strict=True)
    goals = [_rounds(points, distances, f, s, r, n_points) for f, s, r in parts]
    return torch.cat(goals)


@_assign_in_rounds.register_fake
def _(point, distance, row, standing, reach, n_points):  # compilers need only the shape
    return torch.empty_like(standing)


def _rounds(
    points: Tensor, distances: Tensor, first: Tensor, standing: Tensor, reach: Tensor, n_points: int
) -> Tensor:
    """The rounds of some worlds; ``first`` [B, N] indexes each UAV's first one of all candidates
    [M*K]."""
    asked = first.flatten().clone()
    stands = standing.flatten()
    reach = reach.flatten()
    # A world's first point, and the UAV that each point keeps, as a flat number; those of a world
    # count up in index order.
    n_worlds, n_uavs = first.shape
    world = torch.arange(n_worlds, device=first.device)
    base = (world * n_points).repeat_interleave(n_uavs)
    nobody = first.numel()
    keeper = torch.full((n_worlds * n_points,), nobody, device=first.device)
    keeper.index_fill_(0, base + stands, -1)
    booked = stands.clone()
    asking = torch.arange(nobody, device=first.device)
    while len(asking):
        candidate = asked.index_select(0, asking)
        own = stands.index_select(0, asking)
        point = points.index_select(0, candidate).long()
        in_reach = distances.index_select(0, candidate) <= reach.index_select(0, asking)
        flies = in_reach & (point != own)
        booked.index_copy_(0, asking, torch.where(flies, point, own))
        asking = asking[flies]
        point = point[flies]
        wanted = base.index_select(0, asking) + point
        before = keeper.index_select(0, wanted)
        keeper.scatter_reduce_(0, wanted, asking, "amin")
        kept = keeper.index_select(0, wanted) == asking
        displaced = before[kept]
        displaced = displaced[displaced < nobody]
        asking = torch.cat([asking[~kept], displaced])
        asked.index_add_(0, asking, torch.ones_like(asking))
    return booked.view_as(standing)
