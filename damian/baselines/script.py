"""Scripted policies: fly to where the source probably is, or over ground not covered recently.

Every UAV flies to the landing point whose footprint contains the largest total weight.
"""

import math

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor

from damian import keys
from damian.common import checks
from damian.common.tensors import distances, gather_rows, tree_map, where_rows
from damian.envs.delayed_env import DelayedEnv
from damian.envs.forward import Assumed
from damian.envs.uav_env import UavEnv
from damian.server.belief import any_of, chance_of_staying, detection_chance, places, report_rows
from damian.server.features.actions import FLIGHT_COST, LEAST_GAIN, footprint_bits
from damian.server.features.requests import assignments, known_requests
from damian.server.features.search import search_weights, seeking_of
from damian.world.coverage import bit_count
from damian.world.messages import Messages
from damian.world.state import State

PROBABLE = 0.1
"""If a UAV detects the source with this probability somewhere in the next step, it leaves its own
ground."""
WORTH = 0.3
"""Least share of the highest probability of a detection for which a UAV flies to a landing
point."""
SEARCH_STEPS = 4
"""A UAV that searches several sources flies to another place after so many steps."""
GOLDEN = (math.sqrt(5) - 1) / 2
"""The golden ratio, by which it chooses this place."""
MAX_PAIRS = 400_000_000
"""Most pairs of landing points: the script weighs each of them against every other one of its
region."""


def script_policy(env: DelayedEnv) -> TensorDictModule:
    """Build the stateless scripted policy, for an environment with ``message`` among its extras."""
    worlds = env.uav_env
    available = env.observation_spec.keys(True, True)
    if keys.FORWARD in available:
        script = ForwardScript(script_without_belief(worlds))
        forward_keys = [keys.FORWARD, keys.FORWARD_MASK]
        forward_keys = [key for key in forward_keys if key in available]
        return TensorDictModule(script, forward_keys, [keys.ACTION])
    believes = worlds.scenario.seeks_source and keys.BELIEF in available
    own_messages = worlds.scenario.observation.own
    if believes:
        own_messages = keys.OWN_BELIEF in available
    script = _script_of(worlds, believes)
    message = keys.MESSAGE
    if keys.RECEIVED in available:
        message = keys.RECEIVED
    arguments = {"message": message, "mask": keys.ACTION_MASK}
    if script is Searcher:
        arguments |= {"belief": keys.BELIEF, "own_belief": keys.OWN_BELIEF}
    if script is Seeker:
        arguments |= {"age": keys.AGE}
    elif own_messages:
        arguments |= {"own_message": keys.MESSAGE}
    policy = script(worlds)
    if keys.COMMANDS in available:
        arguments |= {"commands": keys.COMMANDS}
        policy = Commander(policy, worlds)
    in_keys = {name: key for name, key in arguments.items() if key in available}
    return TensorDictModule(policy, in_keys, [keys.ACTION])


def script_without_belief(worlds: UavEnv) -> "Seeker":
    """The script as a function of packed messages and legal actions alone."""
    return _script_of(worlds, believes=False)(worlds)


def assumed_script(env: DelayedEnv) -> Assumed:
    """For ``DelayedEnv.assume``: everybody is assumed to follow the script."""
    worlds = env.uav_env
    script = script_without_belief(worlds)
    masked = keys.ACTION_MASK in worlds.observation_spec.keys(True, True)

    def choose(state: State, _: int) -> Tensor:
        mask = worlds.simulation.action_mask(state) if masked else None
        return script(state.sent.pack(), mask=mask)

    return choose


class ForwardScript:
    """Each UAV applies the script to the messages that it expects to be sent now."""

    def __init__(self, script: "Seeker") -> None:
        self.script = script

    def __call__(self, forward: Tensor, mask: Tensor | None = None) -> Tensor:
        """Actions, [B, N] or [B, N, 2], from packed messages [B, N, N, M] (receiver, sender)."""
        if mask is not None:
            mask = mask.flatten(0, 1)
        chosen = self.script(forward.flatten(0, 1), mask=mask)
        everyone = chosen.unflatten(0, forward.shape[:2])
        uav = torch.arange(forward.shape[1], device=forward.device)
        return everyone[:, uav, uav]


def _script_of(worlds: UavEnv, believes: bool) -> "type[Seeker]":
    """The script for the task of some worlds."""
    n_regions, n_points = worlds.simulation.airspace.points.shape[:2]
    n_pairs = n_regions * n_points**2
    checks.require(
        n_pairs <= MAX_PAIRS,
        "region.lattice_step",
        f"{n_points} landing points",
        "are too many for the scripted policy: take a larger step",
    )
    scenario = worlds.scenario
    if scenario.requests.slots:
        return Dispatcher
    if not scenario.seeks_source:
        return Coverer
    if scenario.source.count > 1:
        return Rescuer
    return Searcher if believes else Seeker


class Seeker:
    """Function from messages to actions, for the regions, the source and the UAVs of an
    environment."""

    def __init__(self, worlds: UavEnv) -> None:
        scenario = worlds.scenario
        simulation = worlds.simulation
        server = worlds.server
        self.unpack = server.messages
        self.region_of = server.region_of
        self.counted = server.counted
        self.grid = server.grid
        self.level = server.level
        self.radius = simulation.radius
        self.dt = scenario.clock.dt
        self.candidates = simulation.candidates
        self.actions = scenario.actions
        self.seeking = seeking_of(scenario.source, self.dt)
        self.hears_all = scenario.requests.range is None
        points = simulation.airspace.points
        self.real = points[..., 0].isfinite()
        self.points = points.nan_to_num(posinf=0.0)
        self.n_points = points.shape[1]
        self.near = self.footprint_table()

    def __call__(
        self, message: Tensor, age: Tensor | None = None, mask: Tensor | None = None
    ) -> Tensor:
        """Actions, [B, N] or [B, N, 2], from packed messages [B, N, M], ages [steps] and legal
        actions."""
        held = self.unpack(message)
        region = self.region_of(held)
        ground = self.points[region]
        time = held.time
        if age is not None:
            time = time + age.squeeze(-1) * self.dt
        now = time.amax(-1, keepdim=True)
        landed = gather_rows(self.points.flatten(0, 1), self.counted(held))
        weight = search_weights(held, ground, landed, now, self.radius, self.seeking)
        gain = weight @ self.footprints(region)
        action, _ = self.choose_landing(held, gain, mask)
        return action

    def footprint_table(self) -> Tensor:
        """1 for landing points (rows) in the footprints of others (columns), [R, L, L]."""
        near = distances(self.points, self.points) <= self.radius
        return (near & self.real.unsqueeze(-1)).float()

    def footprints(self, region: Tensor) -> Tensor:
        """The part of ``footprint_table`` for each world, [B or 1, L, ...]."""
        if len(self.near) == 1:
            return self.near
        return self.near[region]

    def choose_landing(
        self, held: Messages, gain: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Actions, and the landing points [B, N] to which they lead, as indices in their region."""
        region = self.region_of(held)
        ground = self.points[region]
        real = self.real[region].unsqueeze(1)
        gain = gain.where(real, -torch.inf)
        flown = distances(held.target, ground)
        goal_place = _places_at(ground, (gain - FLIGHT_COST * flown).argmax(-1))
        left = distances(goal_place, ground)
        if self.actions.kind == "discrete":
            # A UAV that the server has last heard of at its takeoff stands on its target when it
            # chooses.
            nearest = flown.argmin(-1)
            base = region.unsqueeze(-1) * self.n_points
            return self.best_action(nearest + base, gain, left, mask)
        return self.best_move(held, gain, flown, left, ground)

    def best_action(
        self, standing: Tensor, gain: Tensor, left: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """The best legal discrete action from points of these flat ids, [B, N], and where it
        leads."""
        action = torch.arange(self.actions.n_actions, device=gain.device)
        row = standing.unsqueeze(-1) * len(action) + action
        ranking = self.candidates.ranking
        point = gather_rows(ranking.point[:, 0], row).long()
        flown = gather_rows(ranking.distance[:, 0], row)
        gain = gain.gather(-1, point)
        left = left.gather(-1, point)
        if mask is not None:
            gain = gain.where(mask, -torch.inf)
        best = _best(gain, flown, left)
        return best, _entry(point, best)

    def best_move(
        self, held: Messages, gain: Tensor, flown: Tensor, left: Tensor, ground: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Distance and heading in [0, 1] to the best landing point in reach, [B, N, 2], and this
        point."""
        longest = self.candidates.max_distance
        gain = gain.where(flown <= longest, -torch.inf)
        best = _best(gain, flown, left)
        way = _places_at(ground, best) - held.target
        east, north = way.unbind(-1)
        turns = torch.atan2(east, north) / (2 * math.pi)
        heading = torch.remainder(turns, 1.0)
        distance = _entry(flown, best) / longest
        return torch.stack([distance, heading], -1), best


def _best(gain: Tensor, flown: Tensor, left: Tensor) -> Tensor:
    """Index of the choice of most gain, the nearest of equals, or nearest the goal if none gains,
    [B, N]."""
    gains = gain.amax(-1, keepdim=True) > LEAST_GAIN
    net_gain = gain - FLIGHT_COST * flown
    way_left = left.where(gain.isfinite(), torch.inf)
    return torch.where(gains, net_gain, -way_left).argmax(-1)


def _entry(values: Tensor, index: Tensor) -> Tensor:
    """The entry of each row [*, A] at its index [*], [*]."""
    return values.gather(-1, index.unsqueeze(-1)).squeeze(-1)


def _places_at(ground: Tensor, index: Tensor) -> Tensor:
    """Landing points [B, N, 2] of these indices [B, N] among ``ground`` [B, L, 2]."""
    return ground.take_along_dim(index.unsqueeze(-1), 1)


class Commander:
    """A script whose UAVs decide from where the commands that they have sent will have taken
    them."""

    def __init__(self, script: Seeker, worlds: UavEnv) -> None:
        self.script = script
        self.commanded = worlds.server.commanded

    def __call__(
        self, message: Tensor, commands: Tensor, own_message: Tensor | None = None, **known: Tensor
    ) -> Tensor:
        """Actions, [B, N] or [B, N, 2], from what the script reads, and ``commands``."""
        own = self.commanded(message if own_message is None else own_message, commands).pack()
        if type(self.script) is Seeker:  # all follow the messages of all
            return self.script(own, **known)
        return self.script(message, own_message=own, **known)  # type: ignore[call-arg]


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
        own = known
        if own_message is not None:
            own = self.unpack(own_message)
        belief = belief.unsqueeze(1)
        if own_belief is not None:
            belief = own_belief
        region = self.region_of(known)
        level = self.level(known)
        grid = self.grid
        assert grid is not None
        place = places(grid, region, level).unsqueeze(1)
        place = place.expand(belief.shape[:3])
        chance = any_of(detection_chance(grid, belief, place))
        chance = chance.expand(-1, known.time.shape[1], -1)
        here = own.trail[..., :1] % self.n_points
        rows = report_rows(grid, own, level).movedim(-1, -2)
        each = belief.expand(*rows.shape, -1)
        stays = any_of(chance_of_staying(grid, each, rows.unsqueeze(-1)))
        chance = chance.scatter(-1, here, stays)
        chance = chance.masked_fill(self.taken(known), 0.0)
        ground = self.points[region]
        near = distances(own.target, ground) <= self.from_others(known, ground)
        probable = chance.amax(-1, keepdim=True) >= PROBABLE
        chance = torch.where(probable | near, chance, 0.0)
        highest = chance.amax(-1, keepdim=True)
        gain = torch.where(chance >= WORTH * highest, chance, 0.0)
        action, _ = self.choose_landing(own, gain, mask)
        return action

    def from_others(self, known: Messages, ground: Tensor) -> Tensor:
        """Distance from the nearest other UAV to each landing point [m], [B, N, L]; infinite for
        one UAV."""
        distance = distances(known.target, ground).unsqueeze(1)
        n = distance.shape[2]
        itself = torch.eye(n, dtype=torch.bool, device=distance.device).unsqueeze(-1)
        return distance.masked_fill(itself, torch.inf).amin(2)

    def taken(self, known: Messages) -> Tensor:
        """Landing points on which the latest known messages place another UAV, [B, N, L] bool."""
        point = known.trail[..., :1] % self.n_points
        nowhere = point.new_zeros(*point.shape[:2], self.n_points)
        stands = nowhere.scatter(-1, point, 1)
        return stands.sum(1, keepdim=True) > stands


class Coverer(Seeker):
    """Each UAV flies where its footprint holds most new ground; the UAVs choose one after the
    other.

    Ground is new if it lies outside the UAV's own latest footprints, as they are after the next
    landing, and outside those that the UAVs before it choose, as far as it knows. It looks one step
    ahead.
    """

    def footprint_table(self) -> Tensor:
        """The landing points in the footprint of each, as bits, [R, L, W]."""
        bits = footprint_bits(self.candidates.airspace.points, self.radius)
        return bits.unflatten(0, self.points.shape[:2])

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
        claimed = near.new_zeros(len(region), near.shape[-1])
        uavs = torch.arange(message.shape[1], device=message.device)
        for uav in range(len(uavs)):  # what a UAV chooses depends on those before it
            legal = mask
            if mask is not None:
                legal = mask[:, uav : uav + 1]
            if own_message is not None:
                packed = torch.where((uavs == uav).unsqueeze(-1), own_message, message)
                own = self.unpack(packed)
            action, claims = self.choose_new(own, uav, claimed, near, legal)
            actions.append(action)
            if own_message is not None:  # the others do not know where it is
                _, claims = self.choose_new(held, uav, claimed, near, None)
            claimed = claimed | claims
        return torch.cat(actions, 1)

    def choose_new(
        self, known: Messages, uav: int, claimed: Tensor, near: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Action of one UAV, [B, 1], where ground is not ``claimed`` by others, bits [B, W], and
        what it claims itself: the footprint in which it gains new ground."""
        alone = _only(known, uav)
        # The next landing replaces the oldest one.
        latest = self.counted(alone)[:, 0, :-1] % self.n_points
        taken = claimed
        for stop in latest.unbind(-1):
            taken = taken | _footprint_at(near, stop)
        gain = bit_count(near & ~taken.unsqueeze(1)).sum(-1).float()
        action, point = self.choose_landing(alone, gain.unsqueeze(1), mask)
        gains = gain.gather(-1, point) > LEAST_GAIN
        return action, torch.where(gains, _footprint_at(near, point.squeeze(-1)), 0)


class Rescuer(Coverer):
    """UAVs are assigned to known sources, the nearest pair first; the others search all over the
    region."""

    def choose_new(
        self, known: Messages, uav: int, claimed: Tensor, near: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        heard = known.detected_time >= 0  # [B, N, K]
        times = heard.sum(1).clamp(min=1).unsqueeze(-1)
        heard_places = known.detected_position * heard.unsqueeze(-1)
        place = heard_places.sum(1) / times
        goal, assigned = _goal_of(uav, known.target, place, heard.any(1))
        goal = where_rows(assigned, goal, self.searched(known, uav))
        region = self.region_of(known)
        from_goal = distances(goal.unsqueeze(1), self.points[region])
        close = (-from_goal / self.radius).exp()
        action, _ = self.choose_landing(_only(known, uav), close, mask)
        return action, claimed

    def searched(self, known: Messages, uav: int) -> Tensor:
        """Where a UAV that searches flies next, [B, 2]."""
        region = self.region_of(known)
        # A sequence of landing points that leaves no gap: each lies far from those before it.
        n_uavs = known.time.shape[1]
        steps = known.time[:, uav : uav + 1] / self.dt
        turn = (steps / SEARCH_STEPS).floor() * n_uavs + uav
        share = turn * GOLDEN % 1
        n_real = self.real[region].sum(-1, keepdim=True)
        point = (share * n_real).long()
        return _places_at(self.points[region], point).squeeze(1)


class Dispatcher(Rescuer):
    """UAVs are assigned to the open requests that are known, the nearest pair first.

    The others wait or, if requests are not known at once, search.
    """

    def choose_new(
        self, known: Messages, uav: int, claimed: Tensor, near: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        requests, unserved = known_requests(known)
        goal, assigned = _goal_of(uav, known.target, requests[..., :2], unserved)
        alone = _only(known, uav)
        other = alone.target[:, 0]
        if not self.hears_all:
            other = self.searched(known, uav)
        goal = where_rows(assigned, goal, other)
        region = self.region_of(known)
        inside = distances(goal.unsqueeze(1), self.points[region]) <= self.radius
        action, _ = self.choose_landing(alone, inside.float(), mask)
        return action, claimed


def _goal_of(uav: int, targets: Tensor, places: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """The place [B, 2] to which a UAV is assigned, and whether it is to any, [B]."""
    goal = assignments(targets, places, wanted)[:, uav]
    return _places_at(places, goal.clamp(min=0).unsqueeze(-1)).squeeze(1), goal >= 0


def _only(known: Messages, uav: int) -> Messages:
    """What is known of one UAV, [B, 1, ...]."""
    return tree_map(lambda field: field[:, uav : uav + 1], known)


def _footprint_at(footprints: Tensor, point: Tensor) -> Tensor:
    """The footprints [B or 1, L, W] of the landing points of these indices [B], [B, W]."""
    return footprints.take_along_dim(point.view(-1, 1, 1), 1).squeeze(1)
