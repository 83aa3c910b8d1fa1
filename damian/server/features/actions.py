"""What each discrete action offers: where it leads, and what is there, from the known messages."""

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from damian.common import checks
from damian.common.tensors import distances, gather_rows
from damian.server.config import ObservationConfig
from damian.server.features.base import FeatureCache, feature, footprint_radii
from damian.server.features.belief import belief_gain
from damian.server.features.requests import assignments, known_requests
from damian.server.features.search import Seeking, radius_of, search_weights, seeking_of
from damian.server.features.source import known_sources
from damian.world.battery import battery_of, charge_gain, cruise_range, flight_drain, vertical_drain
from damian.world.coverage import bit_count, packed_bits
from damian.world.motion import minimum_time
from damian.world.simulation import Simulation

FLIGHT_COST = 1e-6
"""Cost of a flight [weight per metre]: it only decides between equally good places, for the
nearest."""
LEAST_GAIN = 1e-3
"""If no choice gains more weight than this, all weight lies out of reach."""
_SLOW = 10.0
"""Durations of flights are divided by this number of steps."""
_POINTS_AT_ONCE = 1024
"""Landing points whose distances to all others are computed together, which bounds the memory."""


class ActionTables(NamedTuple):
    """What actions offer before any message has come.

    Rows are landing points by flat id, or, of ``seconds`` and ``drain``, landing points and UAVs.
    """

    goal: Tensor
    """Flat id of the landing point to which each action leads, [R*L, A]."""
    way: Tensor
    """Way to it, east and north, over the length of the longest action, [R*L, A, 2]."""
    length: Tensor
    """Length of the flight [m], [R*L, A]."""
    needed: Tensor
    """The same as it must be within reach, infinite where the action leads outside, [R*L, A]."""
    seconds: Tensor
    """Duration of the flight over ten steps, at most 1, [R*L*N, A], if it is told."""
    drain: Tensor
    """What the flight, or a step of holding, takes from the battery [%], [R*L*N, A]."""
    vertical: Tensor
    """What the battery loses by a takeoff and a landing [%], [N]."""
    range: Tensor
    """Way that one percent of the battery lasts [m], [N]."""
    footprints: Tensor
    """The landing points in the footprint of each, as bits, [V*R*L, W] for V radii."""
    full: Tensor
    """Their largest number in any footprint of this radius, [V*R*L]."""
    inside: Tensor
    """The same as ids within the region, L where there are fewer than most, [V*R*L, P]; [0, P] if
    no single source is sought."""
    seeking: Seeking
    """What is known of the source."""
    ground: Tensor
    """Landing points of the regions [m], [R, L, 2]."""
    instant: bool
    """Whether UAVs are at their targets as soon as a step ends."""


def columns_of_actions(simulation: Simulation, observation: ObservationConfig) -> tuple[str, ...]:
    """What each value of ``actions`` is in a scenario."""
    config = simulation.config
    named = {
        "east": True,
        "north": True,
        "time": not simulation.vehicles.instant,
        "battery": config.battery.enabled,
        "new": True,
        "new to all": config.agents > 1,
        "in turn": observation.advice,
        "source": config.seeks_source,
        "own source": config.seeks_source,
        "request": bool(config.requests.slots),
        "own request": bool(config.requests.slots),
        "request age": bool(config.requests.slots),
        "belief": "belief_gain" in observation.belief,
        "others": config.agents > 1,
        "gain": observation.advice,
        "choice": observation.advice,
        "legal": True,
    }
    return tuple(name for name, exists in named.items() if exists)


def action_tables(simulation: Simulation, _: ObservationConfig) -> ActionTables:
    """Tables of a simulation with discrete actions."""
    candidates = simulation.candidates
    vehicles = simulation.vehicles
    config = simulation.config
    points = simulation.points
    goal = candidates.nearest
    n_actions = goal.shape[1]
    length = candidates.ranking.distance[:, 0].view(-1, n_actions)
    start = torch.arange(len(goal)).unsqueeze(-1)
    way = (points[goal] - points.unsqueeze(1)) / candidates.max_distance
    flies = (goal != start).unsqueeze(-1)
    # What is drawn for an episode is not told: flights are those of the settings.
    values = vehicles.values._replace(choices={})
    battery = battery_of(values, length)
    limits = [values.settings[f"motion.{name}"] for name in ("max_speed", "max_acceleration")]
    airspace = simulation.airspace
    drains = config.battery.enabled
    seeks = config.seeks_source and len(simulation.sources) == 1
    each = length.unsqueeze(-1).expand(*length.shape, config.agents)
    vertical = minimum_time(vehicles.levels, config.motion.degree, *limits)
    seconds = (2 * vertical + minimum_time(each, config.motion.degree, *limits)) * flies
    rests = charge_gain(torch.full_like(each, simulation.dt), battery)
    rests = rests * gather_rows(vehicles.chargers, goal).unsqueeze(-1)
    drain = torch.where(flies, flight_drain(vertical, each, battery), -rests)
    slow = _SLOW * simulation.dt
    radii = footprint_radii(simulation)
    found = [footprint_bits(airspace.points, radius) for radius in radii]
    sizes = [bit_count(bits).sum(-1).amax().float().expand(len(bits)) for bits in found]
    return ActionTables(
        goal=goal,
        way=way.nan_to_num().clamp(-1, 1),
        length=length,
        needed=candidates.distance,
        seconds=length[:0] if vehicles.instant else _by_uav(seconds / slow).clamp(max=1),
        drain=_by_uav(drain) if drains else length[:0],
        vertical=vertical_drain(2 * vertical, battery),
        range=cruise_range(torch.ones(config.agents), battery)
        if drains
        else torch.full((config.agents,), checks.METRES),
        footprints=torch.cat(found),
        full=torch.cat(sizes),
        inside=_listed(torch.cat(found), airspace.max_points) if seeks else goal[:0],
        seeking=seeking_of(config.source, simulation.dt),
        ground=airspace.points,
        instant=vehicles.instant,
    )


def _by_uav(values: Tensor) -> Tensor:
    """Values [P, A, N] as rows for each landing point and UAV, [P*N, A]."""
    return values.movedim(-1, 1).flatten(0, 1).float()


def footprint_bits(points: Tensor, radius: float) -> Tensor:
    """The landing points [R, L, 2] in the footprint about each, bits of [R*L, W] int64."""
    n_bits = -(-points.shape[1] // 64) * 64
    found = []
    for ground in points:
        real = ground.isfinite().all(-1)
        filled = ground.nan_to_num(posinf=0.0)
        for about, exists in zip(
            filled.split(_POINTS_AT_ONCE), real.split(_POINTS_AT_ONCE), strict=True
        ):
            near = distances(about, filled) <= radius
            near = near & real & exists.unsqueeze(-1)
            bits = F.pad(near, (0, n_bits - near.shape[-1]))
            found.append(packed_bits(bits.numpy()))
    return torch.cat(found)


def _listed(bits: Tensor, n_points: int) -> Tensor:
    """Which bits of [M, W] are set, [M, P], ``n_points`` where there are fewer than most."""
    number = torch.arange(64 * bits.shape[-1])
    is_set = (bits[:, number // 64] >> (number % 64)) & 1
    n_most = int(is_set.sum(-1).amax())
    return torch.where(is_set > 0, number, n_points).sort(-1).values[:, :n_most]


def stands(v: FeatureCache) -> Tensor:
    """Flat ids of the landing points from which the UAVs choose next, [*, N]: where they stand, or
    to which they fly."""
    tables = v.table(action_tables)
    if tables.instant:
        return v.messages.trail[..., 0]
    return v.messages.bound_for(tables.ground, v.region)


def legal(v: FeatureCache) -> Tensor:
    """Whether each UAV may choose each action, as far as its message tells, [*, N, A]."""
    tables = v.table(action_tables)
    needed = gather_rows(tables.needed, v(stands))
    reach = (v.messages.battery - tables.vertical) * tables.range
    reach = reach.clamp(min=0).unsqueeze(-1)
    allowed = needed <= reach
    stuck = ~allowed.any(-1, keepdim=True)
    return allowed | stuck


def grounds(v: FeatureCache) -> Tensor:
    """Bits of the ground in the footprint of where each action of each UAV leads, [*, N, A, W]."""
    tables = v.table(action_tables)
    goal = gather_rows(tables.goal, v(stands))
    return gather_rows(tables.footprints, v.tabled(goal))


def covered(v: FeatureCache) -> Tensor:
    """Bits of the ground in the latest footprints of each UAV, but that which the next landing
    replaces, [*, N, W]."""
    *latest, _ = v.tabled(v.trail).unbind(-1)
    footprints = v.table(action_tables).footprints
    found = footprints.new_zeros(*v.messages.time.shape, footprints.shape[-1])
    for stop in latest:
        found = found | gather_rows(footprints, stop)
    return found


def _number(bits: Tensor) -> Tensor:
    """How many bits are set in [*, W], [*]."""
    return bit_count(bits).sum(-1).float()


def claimed(v: FeatureCache) -> Tensor:
    """Bits of the ground that the UAVs before each one will cover, if each of them chooses in turn
    as ``scripted`` does, [*, N, W]."""
    tables = v.table(action_tables)
    length = gather_rows(tables.length, v(stands))
    own = v(covered)
    by_uav = zip(
        v(grounds).unbind(-3), own.unbind(-2), v(legal).unbind(-2), length.unbind(-2), strict=True
    )
    before = [torch.zeros_like(own[..., 0, :])]
    for ground, known, allowed, flown in by_uav:
        taken = (known | before[-1]).unsqueeze(-2)
        gain = _number(ground & ~taken).where(allowed, -torch.inf)
        best = (gain - FLIGHT_COST * flown).argmax(-1, keepdim=True)
        gains = gain.amax(-1, keepdim=True) > LEAST_GAIN
        footprint = ground.take_along_dim(best.unsqueeze(-1), -2).squeeze(-2)
        before.append(before[-1] | torch.where(gains, footprint, 0))
    return torch.stack(before[:-1], -2)


def _closeness(v: FeatureCache, places: Tensor, exists: Tensor) -> tuple[Tensor, Tensor]:
    """exp(-distance/radius) from where actions lead to places [*, K, 2] that ``exists`` [*, K]
    marks, [*, n, A, K]; and whether each wanted UAV is assigned to it, [*, n, 1, K]."""
    away = _from_goals(v, places)
    close = (-away / radius_of(v.radius)).exp() * exists[..., None, None, :]
    goal = assignments(v.messages.target, places, exists)
    place = torch.arange(places.shape[-2], device=places.device)
    return close, v.wanted(goal.unsqueeze(-1) == place).unsqueeze(-2)


def _from_goals(v: FeatureCache, places: Tensor) -> Tensor:
    """Distances from where actions lead to places [*, K, 2] [m], [*, n, A, K]."""
    ways = v(goal_places).unsqueeze(-2) - places[..., None, None, :, :]
    return ways.square().sum(-1).sqrt()


def itself(v: FeatureCache) -> Tensor:
    """Number of each wanted UAV, [*, n]."""
    time = v.messages.time
    return v.wanted(torch.arange(time.shape[-1], device=time.device).expand(time.shape))


def goal_places(v: FeatureCache) -> Tensor:
    """Where the actions of the wanted UAVs lead [m], [*, n, A, 2]."""
    goal = gather_rows(v.table(action_tables).goal, v.wanted(v(stands)))
    return gather_rows(v.context.points, goal)


def source_gain(v: FeatureCache) -> Tensor:
    """What listening where actions lead is worth by ``search_weights``, [*, n, A]."""
    tables = v.table(action_tables)
    ground = gather_rows(tables.ground, v.region).nan_to_num(posinf=0.0)
    landed = gather_rows(v.context.points, v.trail)
    now = v.context.now.unsqueeze(-1)
    weights = search_weights(v.messages, ground, landed, now, v.radius, tables.seeking)
    weights = F.pad(v.wanted(weights), (0, 1))
    goal = gather_rows(tables.goal, v.wanted(v(stands)))
    inside = gather_rows(tables.inside, v.tabled(goal))
    return weights.unsqueeze(-2).expand(*goal.shape, -1).gather(-1, inside).sum(-1)


def _if_any(gain: Tensor, other: Tensor) -> Tensor:
    """The gains [*, n, A] of UAVs that gain anything, of the rest ``other``."""
    return torch.where(gain.amax(-1, keepdim=True) > 0, gain, other)


def _near_others(v: FeatureCache) -> Tensor:
    """exp(-distance/radius) from where actions lead to the nearest target of another UAV,
    [*, n, A]."""
    targets = v.messages.target
    away = _from_goals(v, targets)
    uav = torch.arange(targets.shape[-2], device=targets.device)
    own = uav == v(itself)[..., None, None]
    return (-away.masked_fill(own, torch.inf) / radius_of(v.radius)).exp().amax(-1)


@feature(
    "actor",
    [None, None],
    low=-1.0,
    name="actions",
    entries=columns_of_actions,
    rows="actions",
    tables=[action_tables],
)
def _actions(v: FeatureCache) -> Tensor:
    """For each discrete action what it offers, by the messages that are known, [*, N, A, C].

    ``east``, ``north``: the way, over the longest action; ``time`` of the flight, over ten steps;
    ``battery`` after it, as a share. New ground in the footprint of where it leads, as a share of a
    full footprint: outside the UAV's own latest footprints (``new``), outside those of all UAVs
    (``new to all``), and outside its own and those that the UAVs before it will choose, if they
    choose as the script does (``in turn``). exp(-distance/radius) from there to the nearest known
    source, and to that to which the script assigns the UAV (``own source``); the same
    of open requests, and the age of the oldest in the footprint; the ``belief_gain``; and the
    nearest target of another UAV. ``gain``: what the UAV gains in its task, as a rule of thumb has
    it, less a little for the way; ``choice``: 1 for the legal action of the largest gain;
    ``legal``: whether the UAV may choose it. ``in turn``, ``gain`` and ``choice`` stand only where
    ``observation.advice`` is set. What a scenario does not have is left out. In flight,
    actions begin at the destination.
    """
    names = v.table(columns_of_actions)
    tables = v.table(action_tables)
    standing = v.wanted(v(stands))
    allowed = v.wanted(v(legal))
    ground = v.wanted(v(grounds))
    full = gather_rows(tables.full, v.tabled(standing)).unsqueeze(-1)
    own = v.wanted(v(covered))
    east, north = gather_rows(tables.way, standing).unbind(-1)
    found = {"east": east, "north": north, "legal": allowed.float()}
    row = standing * v.messages.time.shape[-1] + v(itself)
    if "time" in names:
        found["time"] = gather_rows(tables.seconds, row)
    if "battery" in names:
        level = v.wanted(v.messages.battery).unsqueeze(-1)
        found["battery"] = (level - gather_rows(tables.drain, row)).clamp(0, 100) / 100
    taken = {"new": own}
    if "in turn" in names:
        taken["in turn"] = own | v.wanted(v(claimed))
    if "new to all" in names:
        everyone = torch.zeros_like(v(covered)[..., :1, :])
        for one in v(covered).split(1, -2):
            everyone = everyone | one
        taken["new to all"] = everyone
    for name, known in taken.items():
        found[name] = _number(ground & ~known.unsqueeze(-2)) / full
    if "source" in names:
        close, is_assigned = _closeness(v, *known_sources(v))
        found["source"] = close.amax(-1)
        found["own source"] = (close * is_assigned).amax(-1)
    if "request" in names:
        requests, unserved = known_requests(v.messages)
        place, appeared = requests.split([2, 1], -1)
        close, is_assigned = _closeness(v, place, unserved)
        found["request"] = close.amax(-1)
        found["own request"] = (close * is_assigned).amax(-1)
        inside = close >= math.exp(-1)  # the footprint ends where the closeness is this
        age = (v.context.now[..., None] - appeared.squeeze(-1)) / v.context.time_scale
        age = age.clamp(0, 1)[..., None, None, :]
        found["request age"] = (age * inside).amax(-1)
    if "belief" in names:
        found["belief"] = v(belief_gain.compute)
    if "others" in names:
        found["others"] = _near_others(v)
    if "gain" in names:
        length = gather_rows(tables.length, standing)
        net = _script_gain(v, found, full) - FLIGHT_COST * length / full
        found["gain"] = net.clamp(min=-1)
        best = net.where(allowed, -torch.inf).argmax(-1, keepdim=True)
        found["choice"] = torch.zeros_like(net).scatter(-1, best, 1.0)
    return torch.stack([found[name] for name in names], -1)


def _script_gain(v: FeatureCache, found: dict[str, Tensor], full: Tensor) -> Tensor:
    """What each action gains by the script, flights apart, [*, n, A], from the other columns that
    were ``found``, and the size of a full footprint."""
    tables = v.table(action_tables)
    if "belief" in found:
        return found["belief"]
    if "request" in found:
        length = gather_rows(tables.length, v.wanted(v(stands)))
        return _if_any(found["own request"], (-length / v.radius).exp())
    if "source" not in found:
        return found["in turn"]
    if len(tables.inside):
        return v(source_gain) / full
    return _if_any(found["own source"], found["in turn"])
