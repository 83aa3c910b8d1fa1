"""Scripted policies: fly to where the source probably is, or over ground not covered recently.

Every UAV flies to the landing point whose footprint contains the largest total weight.
"""

import math

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor

from damian import keys
from damian.common import checks
from damian.common.tensors import distances, gather_rows, tree_map
from damian.envs.delayed_env import DelayedEnv
from damian.envs.uav_env import UavEnv
from damian.server.belief import any_of, chance_of_staying, detection_chance, places, report_rows
from damian.server.features.requests import known_requests
from damian.world.messages import Messages

BLUR_M = 5.0
"""Standard deviation of a detection's place [m]: landing points stand for the ground around
them."""
TRUST = 0.9
"""Confidence, in [0, 1], that there is no source in a footprint in which a UAV hears nothing."""
RECENT = 3.0
"""A detection is recent until the source can have moved by this many footprint radii."""
_FLIGHT_COST = 1e-6
"""Cost of a flight [weight per metre]: it only decides between equally good places, for the
nearest."""
_LEAST_GAIN = 1e-3
"""If no choice gains more weight than this, all weight lies out of reach."""
PROBABLE = 0.1
"""If a UAV detects the source with this probability somewhere in the next step, it leaves its own
ground."""
WORTH = 0.3
"""Least share of the highest probability of a detection for which a UAV flies to a landing
point."""
SEARCH_STEPS, GOLDEN = 4, (math.sqrt(5) - 1) / 2
"""A UAV that searches several sources flies to another place after so many steps, by the golden
ratio."""
MAX_PAIRS = 400_000_000
"""Most pairs of landing points: the script weighs each of them against every other one of its
region."""


def script_policy(env: DelayedEnv) -> TensorDictModule:
    """Build the stateless scripted policy, for an environment with ``message`` among its extras."""
    n_regions, n_points = env.uav_env.simulation.airspace.points.shape[:2]
    shown = f"{n_points} landing points"
    should = "are too many for the scripted policy: take a larger step"
    checks.require(n_regions * n_points**2 <= MAX_PAIRS, "region.lattice_step", shown, should)
    available = env.observation_spec.keys(True, True)
    scenario = env.uav_env.scenario
    believes = keys.BELIEF in available and scenario.seeks_source
    message = keys.RECEIVED if keys.RECEIVED in available else keys.MESSAGE
    own_messages = keys.OWN_BELIEF in available if believes else scenario.observation.own
    script = Searcher if believes else Seeker if scenario.seeks_source else Coverer
    if scenario.source.count > 1 and scenario.seeks_source:
        script = Rescuer
    if scenario.requests.slots:
        script = Dispatcher
    arguments: dict[str, NestedKey] = {"message": message, "mask": keys.ACTION_MASK}
    if script is Searcher:
        arguments |= {"belief": keys.BELIEF, "own_belief": keys.OWN_BELIEF}
    if script is Seeker:
        arguments |= {"age": keys.AGE}
    elif own_messages:
        arguments |= {"own_message": keys.MESSAGE}
    in_keys = {name: key for name, key in arguments.items() if key in available}
    return TensorDictModule(script(env.uav_env), in_keys, [keys.ACTION])


class Seeker:
    """Function from messages to actions, for the regions, the source and the UAVs of an
    environment."""

    def __init__(self, worlds: UavEnv) -> None:
        scenario = worlds.scenario
        simulation = worlds.simulation
        server = worlds.server
        source = scenario.source
        self.unpack = server.messages
        self.region_of = server.region_of
        self.counted = server.counted
        self.grid = server.grid
        self.level = server.level
        self.radius = simulation.radius
        self.dt = scenario.clock.dt
        self.candidates = simulation.candidates
        self.actions = scenario.actions
        self.speed = max(source.speed, source.local_speed) if source.motion == "dynamic" else 0.0
        self.emits = source.emits
        self.hears_all = scenario.requests.range is None
        self.real = simulation.airspace.points[..., 0].isfinite()
        self.points = simulation.airspace.points.nan_to_num(posinf=0.0)
        near = distances(self.points, self.points) <= self.radius
        # A row is a landing point to cover, a column the one in whose footprint it lies.
        self.near = (near & self.real.unsqueeze(-1)).float()

    def __call__(
        self, message: Tensor, age: Tensor | None = None, mask: Tensor | None = None
    ) -> Tensor:
        """Actions, [B, N] or [B, N, 2], from packed messages [B, N, M], ages [steps] and legal
        actions."""
        held = self.unpack(message)
        region = self.region_of(held)
        ground = self.points[region]
        time = held.time if age is None else held.time + age.squeeze(-1) * self.dt
        likely, recent = self.believe(held, ground, time.amax(-1, keepdim=True))
        weight = torch.where(recent, likely, self.fresh(held, ground) * likely)
        return self.choose_landing(held, weight @ self.footprints(region), region, mask)[0]

    def footprints(self, region: Tensor) -> Tensor:
        """1 for landing points (rows) in the footprints of others (columns), [B or 1, L, L]."""
        return self.near if len(self.near) == 1 else self.near[region]

    def choose_landing(
        self, held: Messages, gain: Tensor, region: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Actions, and the landing points [B, N] to which they lead, as indices in their region."""
        ground = self.points[region]
        gain = gain.where(self.real[region].unsqueeze(1), -torch.inf)
        flown = distances(held.target, ground)
        goal = (gain - _FLIGHT_COST * flown).argmax(-1)
        left = distances(_places_at(ground, goal), ground)
        if self.actions.kind == "discrete":
            # A UAV that the server has last heard of at its takeoff stands on its target when it
            # chooses.
            standing = flown.argmin(-1) + region.unsqueeze(-1) * self.points.shape[1]
            return self.best_action(standing, gain, left, mask)
        return self.best_move(held, gain, flown, left, ground)

    def fresh(self, held: Messages, ground: Tensor) -> Tensor:
        """1 for landing points [B, L, 2] nearest to the UAV and outside its latest footprints,
        [B, N, L]."""
        distance = distances(held.target, ground)
        own = distance <= distance.amin(1, keepdim=True)
        landed = gather_rows(self.points.flatten(0, 1), self.counted(held))
        from_trail = distances(landed, ground.unsqueeze(1))
        return (own & (from_trail > self.radius).all(-2)).float()

    def believe(self, held: Messages, ground: Tensor, now: Tensor) -> tuple[Tensor, Tensor]:
        """How likely the source is at each landing point [B, L, 2], relative to the best one,
        [B, 1, L].

        The place of a detection grows uncertain with its age: the way of the source at full speed
        counts as two standard deviations. A footprint in which a UAV on the ground hears nothing
        ``now`` [s] makes it less likely there. Also returns whether the latest detection is recent,
        [B, 1, 1].
        """
        detected = held.detected_time.squeeze(-1)
        has_detection = detected >= 0
        since = torch.where(has_detection, now - detected, torch.inf).unsqueeze(-1)
        outside = (distances(held.detected_position.squeeze(-2), ground) - self.radius).clamp(min=0)
        log_detected = -(outside / (BLUR_M + self.speed * since / 2)).square() / 2
        log_detected = torch.where(has_detection.unsqueeze(-1), log_detected, 0.0).sum(
            1, keepdim=True
        )
        silent = ~held.spotted & ~held.in_flight & (held.time > now - self.dt / 2)
        covered = (distances(held.position, ground) <= self.radius) & silent.unsqueeze(-1)
        latest = since.amin(1, keepdim=True)
        confidence = TRUST * torch.where(latest < self.dt / 2, 1.0, self.emits)
        log = log_detected + torch.log1p(-confidence * covered.any(1, keepdim=True))
        moved = torch.where(latest.isfinite(), latest * self.speed, torch.inf)
        return (log - log.amax(-1, keepdim=True)).exp(), moved <= RECENT * self.radius

    def best_action(
        self, standing: Tensor, gain: Tensor, left: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """The best legal discrete action from points of these flat ids, [B, N], and where it
        leads."""
        action = torch.arange(self.actions.n_actions, device=gain.device)
        row = standing.unsqueeze(-1) * len(action) + action
        point, flown = (gather_rows(table[:, 0], row) for table in self.candidates.ranking)
        gain, left = (values.gather(-1, point.long()) for values in (gain, left))
        best = _best(gain if mask is None else gain.where(mask, -torch.inf), flown, left)
        return best, point.long().gather(-1, best.unsqueeze(-1)).squeeze(-1)

    def best_move(
        self, held: Messages, gain: Tensor, flown: Tensor, left: Tensor, ground: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Distance and heading in [0, 1] to the best landing point in reach, [B, N, 2], and this
        point."""
        best = _best(gain.where(flown <= self.candidates.max_distance, -torch.inf), flown, left)
        east, north = (_places_at(ground, best) - held.target).unbind(-1)
        heading = torch.remainder(torch.atan2(east, north) / (2 * math.pi), 1.0)
        distance = flown.gather(-1, best.unsqueeze(-1)).squeeze(-1) / self.candidates.max_distance
        return torch.stack([distance, heading], -1), best


def _best(gain: Tensor, flown: Tensor, left: Tensor) -> Tensor:
    """Index of the choice of most gain, the nearest of equals, or nearest the goal if none gains,
    [B, N]."""
    gains = gain.amax(-1, keepdim=True) > _LEAST_GAIN
    return torch.where(
        gains, gain - _FLIGHT_COST * flown, -left.where(gain.isfinite(), torch.inf)
    ).argmax(-1)


def _places_at(ground: Tensor, index: Tensor) -> Tensor:
    """Landing points [B, N, 2] of these indices [B, N] among ``ground`` [B, L, 2]."""
    return ground.gather(1, index.unsqueeze(-1).expand(*index.shape, 2))


class Searcher(Seeker):
    """Each UAV flies where it most probably detects the source, or else searches its own ground."""

    def __call__(  # type: ignore[override]
        self,
        message: Tensor,
        belief: Tensor,
        own_message: Tensor | None = None,
        own_belief: Tensor | None = None,
        mask: Tensor | None = None,
    ) -> Tensor:
        """Actions, [B, N] or [B, N, 2], from packed messages [B, N, M] and beliefs [B, K, C].

        Where each UAV knows its own messages, ``own_message`` [B, N, M] are these, and
        ``own_belief`` [B, N, K, C] follows from them.
        """
        known = self.unpack(message)
        own = known if own_message is None else self.unpack(own_message)
        region = self.region_of(known)
        level = self.level(known)
        belief = belief.unsqueeze(1) if own_belief is None else own_belief
        assert self.grid is not None
        place = places(self.grid, region, level).unsqueeze(1).expand(belief.shape[:3])
        ground = self.points[region]
        chance = any_of(detection_chance(self.grid, belief, place)).expand(
            -1, known.time.shape[1], -1
        )
        here = own.trail[..., :1] % self.points.shape[1]
        rows = report_rows(self.grid, own, level).movedim(-1, -2)
        each = belief.expand(*rows.shape, -1)
        stays = any_of(chance_of_staying(self.grid, each, rows.unsqueeze(-1)))
        chance = chance.scatter(-1, here, stays).masked_fill(self.taken(known), 0.0)
        near = distances(own.target, ground) <= self.from_others(known, ground)
        probable = chance.amax(-1, keepdim=True) >= PROBABLE
        chance = torch.where(probable | near, chance, 0.0)
        worth = chance >= WORTH * chance.amax(-1, keepdim=True)
        return self.choose_landing(own, torch.where(worth, chance, 0.0), region, mask)[0]

    def from_others(self, known: Messages, ground: Tensor) -> Tensor:
        """Distance from the nearest other UAV to each landing point [m], [B, N, L]; infinite for
        one UAV."""
        distance = distances(known.target, ground).unsqueeze(1)
        n = distance.shape[2]
        itself = torch.eye(n, dtype=torch.bool, device=distance.device).unsqueeze(-1)
        return distance.masked_fill(itself, torch.inf).amin(2)

    def taken(self, known: Messages) -> Tensor:
        """Landing points on which the latest known messages place another UAV, [B, N, L] bool."""
        point = known.trail[..., :1] % self.points.shape[1]
        stands = point.new_zeros(*point.shape[:2], self.points.shape[1]).scatter(-1, point, 1)
        return stands.sum(1, keepdim=True) > stands


class Coverer(Seeker):
    """Each UAV flies where its footprint holds most new ground; the UAVs choose one after the
    other.

    Ground is new if it lies outside the UAV's own latest footprints, as they are after the next
    landing, and outside those that the UAVs before it choose, as far as it knows. It looks one step
    ahead.
    """

    def __call__(  # type: ignore[override]
        self, message: Tensor, own_message: Tensor | None = None, mask: Tensor | None = None
    ) -> Tensor:
        """Actions, [B, N] or [B, N, 2], from packed messages [B, N, M] and legal actions [B, N, A].

        Where each UAV knows its own messages, ``own_message`` [B, N, M] are these.
        """
        held = own = self.unpack(message)
        region = self.region_of(held)
        actions = []
        near = self.footprints(region)
        claimed = torch.zeros(len(region), near.shape[-1], device=message.device)
        for uav in range(message.shape[1]):  # what a UAV chooses depends on those before it
            legal = None if mask is None else mask[:, uav : uav + 1]
            if own_message is not None:
                itself = torch.arange(message.shape[1], device=message.device) == uav
                own = self.unpack(torch.where(itself.unsqueeze(-1), own_message, message))
            action, point = self.choose_new(own, uav, claimed, near, legal)
            actions.append(action)
            if own_message is not None:  # the others do not know where it is
                _, point = self.choose_new(held, uav, claimed, near, None)
            claimed = torch.maximum(claimed, _footprints_of(point, near).squeeze(1))
        return torch.cat(actions, 1)

    def choose_new(
        self, known: Messages, uav: int, claimed: Tensor, near: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Action and landing point of one UAV, [B, 1], where ground is not ``claimed`` [B, L] by
        others."""
        alone = tree_map(lambda field: field[:, uav : uav + 1], known)
        # The next landing replaces the oldest one.
        latest = self.counted(alone)[:, 0, :-1] % self.points.shape[1]
        covered = torch.cat([_footprints_of(latest, near), claimed.unsqueeze(1)], 1).amax(
            1, keepdim=True
        )
        return self.choose_landing(alone, (1 - covered) @ near, self.region_of(known), mask)


class Rescuer(Coverer):
    """UAVs are assigned to known sources, the nearest pair first; the others search all over the
    region."""

    def choose_new(
        self, known: Messages, uav: int, claimed: Tensor, near: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        heard = known.detected_time >= 0  # [B, N, K]
        times = heard.sum(1).clamp(min=1).unsqueeze(-1)
        place = (known.detected_position * heard.unsqueeze(-1)).sum(1) / times
        goal, assigned = _assigned(known.target, place, heard.any(1), uav)
        alone = tree_map(lambda field: field[:, uav : uav + 1], known)
        goal = torch.where(assigned.unsqueeze(-1), goal, self.searched(known, uav))
        region = self.region_of(known)
        close = (-distances(goal.unsqueeze(1), self.points[region]) / self.radius).exp()
        return self.choose_landing(alone, close, region, mask)

    def searched(self, known: Messages, uav: int) -> Tensor:
        """Where a UAV that searches flies next, [B, 2]."""
        region = self.region_of(known)
        # A sequence of landing points that leaves no gap: each lies far from those before it.
        turn = (known.time[:, uav : uav + 1] / self.dt / SEARCH_STEPS).floor() * known.time.shape[
            1
        ] + uav
        point = (turn * GOLDEN % 1 * self.real[region].sum(-1, keepdim=True)).long()
        return _places_at(self.points[region], point).squeeze(1)


class Dispatcher(Rescuer):
    """UAVs are assigned to the open requests that are known, the nearest pair first.

    The others wait or, if requests are not known at once, search.
    """

    def choose_new(
        self, known: Messages, uav: int, claimed: Tensor, near: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        requests, unserved = known_requests(known)
        goal, assigned = _assigned(known.target, requests[..., :2], unserved, uav)
        alone = tree_map(lambda field: field[:, uav : uav + 1], known)
        other = alone.target[:, 0] if self.hears_all else self.searched(known, uav)
        goal = torch.where(assigned.unsqueeze(-1), goal, other)
        region = self.region_of(known)
        inside = distances(goal.unsqueeze(1), self.points[region]) <= self.radius
        return self.choose_landing(alone, inside.float(), region, mask)


def _assigned(uavs: Tensor, places: Tensor, wanted: Tensor, uav: int) -> tuple[Tensor, Tensor]:
    """The place [B, 2] of those wanted [B, K] to which a UAV is assigned, and whether it is to any,
    [B].

    UAVs are at ``uavs`` [B, N, 2], places at [B, K, 2] m; of those left, the nearest pair is
    assigned first.
    """
    cost = distances(uavs, places).masked_fill(~wanted.unsqueeze(1), torch.inf)
    goal = places[:, 0].clone()
    assigned = torch.zeros(len(uavs), dtype=torch.bool, device=uavs.device)
    for _ in range(min(cost.shape[1:])):
        least, pair = cost.flatten(1).min(-1)
        one = pair // cost.shape[2]
        place = pair % cost.shape[2]
        own = (one == uav) & least.isfinite()
        goal = torch.where(
            own.unsqueeze(-1), _places_at(places, place.unsqueeze(1)).squeeze(1), goal
        )
        assigned = assigned | own
        rows = torch.arange(cost.shape[1], device=uavs.device) == one.unsqueeze(-1)
        columns = torch.arange(cost.shape[2], device=uavs.device) == place.unsqueeze(-1)
        cost = cost.masked_fill(rows.unsqueeze(-1) | columns.unsqueeze(1), torch.inf)
    return goal, assigned


def _footprints_of(point: Tensor, near: Tensor) -> Tensor:
    """1 for the landing points in the footprints of those of these indices [B, P], [B, P, L]."""
    rows = near.expand(len(point), -1, -1)
    return rows.gather(1, point.unsqueeze(-1).expand(-1, -1, rows.shape[-1]))
