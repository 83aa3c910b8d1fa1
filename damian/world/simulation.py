"""The physics of B worlds at once: decisions, flights, the source, and the messages that the UAVs send.

Pure functions of (state, action) over tensors, so that a step compiles into a few kernels. What a world
can begin with (start points, the source's walk) is drawn once, as *situations*; a reset only picks one.
"""

import math

import numpy as np
import torch
from torch import Tensor

from damian.common import counter_rng
from damian.common.errors import InputError
from damian.envs.scenario import ScenarioConfig
from damian.server.features import Snapshot
from damian.world.airspace import Airspace, inside, nearest_points, rows
from damian.world.battery import (
    charge_gain,
    cruise_range,
    flight_drain,
    used_so_far,
    vertical_drain,
)
from damian.world.landing import Candidates, book
from damian.world.motion import flight_levels, fly, minimum_time
from damian.world.regions.polygon import MAX_COORDINATE_M
from damian.world.signal_source import Walk, draw_walks, footprint_radius, locate
from damian.world.state import EPISODE, SEED, Layout, Rows, State, tree_map, where

_TIME_EPS = 1e-4
"""Seconds; far below any step, far above float32 error within an episode."""


class Simulation:
    """Worlds of one scenario; holds what never changes."""

    def __init__(self, config: ScenarioConfig, seed: int) -> None:
        """Draw regions and situations, on the CPU.

        Raises:
            InputError: the scenario asks for something impossible.
        """
        rng = np.random.default_rng(seed)
        self.config = config
        self.dt = config.clock.dt
        self.flies = config.motion.kind == "polynomial"
        self.radius = footprint_radius(config.source)
        self.airspace = config.airspace(rng)
        self.candidates = Candidates(self.airspace, config.actions, config.agents)
        region, start, self.walk = _draw_situations(config, self.airspace, rng)
        self.points = self.airspace.points.flatten(0, 1)
        self.levels = torch.tensor(flight_levels(config.motion, config.agents))
        self.vertical = self._shortest(self.levels)
        self.vertical_drain = vertical_drain(2 * self.vertical, config.battery)
        self.charge = float(charge_gain(torch.tensor(self.dt), config.battery))
        self.chargers = _chargers(config, self.airspace)
        self.initial = self._begin(region, start, seed)
        self.layout = Layout(self.initial)
        self.beginnings = self.layout.pack(self.initial)

    def to(self, device: torch.device) -> "Simulation":
        """Move everything, in place."""
        self.airspace = self.airspace.to(device)
        self.candidates.to(device)
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                setattr(self, name, value.to(device))
            elif isinstance(value, (Walk, State, Rows)):
                setattr(self, name, tree_map(lambda t: t.to(device), value))
        return self

    @property
    def n_situations(self) -> int:
        return len(self.initial.situation)

    def reset(self, worlds: Rows, mask: Tensor) -> Rows:
        """Begin a new episode in the worlds of the mask [B]; the others stay as they are."""
        chosen = mask.nonzero().squeeze(-1)  # mostly few
        fresh = self.next_episode(tree_map(lambda rows: rows.index_select(0, chosen), worlds))
        return tree_map(lambda old, new: old.index_copy(0, chosen, new), worlds, fresh)

    def next_episode(self, worlds: Rows) -> Rows:
        """A new episode in each of these worlds."""
        seed, episode = worlds.integers[:, SEED], worlds.integers[:, EPISODE] + 1
        situation = counter_rng.bits(seed, episode) % self.n_situations
        fresh = tree_map(lambda table: table.index_select(0, situation), self.beginnings)
        kept = torch.stack([seed, episode], 1)  # the first two columns
        return fresh._replace(integers=torch.cat([kept, fresh.integers[:, kept.shape[1] :]], 1))

    def step(self, state: State, action: Tensor, acts: Tensor | None = None) -> State:
        """One simulation step of ``dt``; actions of UAVs that are not ready change nothing.

        Args:
            state: before it.
            action: discrete [B, N], or continuous [B, N, 2] in [0, 1].
            acts: whose action counts, [B, N]; everybody's if not given.
        """
        state = self._decide(state, action, acts)
        state = self._fly(state) if self.flies else self._jump(state)
        return self._sense(state._replace(steps=state.steps + 1), acts)

    def ready(self, state: State) -> Tensor:
        """May the UAV choose now, [B, N]."""
        if not self.flies:
            return torch.ones_like(state.talks)
        return state.elapsed >= self._duration(state) + self.config.motion.sensing_time - _TIME_EPS

    def landed(self, state: State) -> Tensor:
        """Does the UAV stand on its landing point, [B, N]."""
        return state.elapsed >= self._duration(state) - _TIME_EPS

    def action_mask(self, state: State) -> Tensor:
        """Discrete actions that would do something, [B, N, A]; while not ready, one that holds.

        A single legal action has log-probability 0 and no gradient: in flight a policy learns nothing.
        """
        distance = rows(self.candidates.distance, state.goal)
        reach = self.reach(state).unsqueeze(-1)
        valid = distance <= reach
        if not self.candidates.can_hold:
            valid = valid | ~valid.any(-1, keepdim=True)
        if not self.flies:
            return valid
        return torch.where(reach >= 0, valid, self.candidates.hold)

    def reach(self, state: State) -> Tensor:
        """How far the UAV may fly now [m], [B, N]: 0 if it can only hold, negative if it may not choose."""
        if self.config.battery.enabled:
            left = cruise_range(state.battery - self.vertical_drain, self.config.battery).clamp(min=0)
        else:
            left = torch.full_like(state.battery, MAX_COORDINATE_M)
        return torch.where(self.ready(state), left, -1.0)

    # One step, in order.

    def _decide(self, state: State, action: Tensor, acts: Tensor | None) -> State:
        """Book landing points and start flights."""
        base = state.region.unsqueeze(-1) * self.airspace.max_points
        standing = state.goal - base
        ranking, row = self.candidates.of(state.goal, state.region, action)
        reach = self.reach(state)
        if acts is not None:
            reach = torch.where(acts, reach, -1.0)
        ready = reach >= 0
        goal = book(ranking, row, standing, reach, self.airspace.max_points) + base
        departs = goal != state.goal
        east, north = (rows(self.points, goal) - rows(self.points, state.goal)).unbind(-1)
        heading = torch.remainder(torch.atan2(east, north), 2 * math.pi)
        state = state._replace(
            track=torch.where(departs, heading, state.track),
            motions=state.motions + ready,
            origin=torch.where(ready, state.goal, state.origin) if self.flies else state.goal,
            goal=goal,
        )
        return self._take_off(state, ready, departs) if self.flies else state

    def _take_off(self, state: State, ready: Tensor, departs: Tensor) -> State:
        cruise = self._shortest(self._length(state.origin, state.goal))
        return state._replace(
            elapsed=torch.where(ready, 0.0, state.elapsed),
            vertical=torch.where(ready, self.vertical * departs, state.vertical),
            cruise=torch.where(ready, cruise, state.cruise),
            used=torch.where(ready, 0.0, state.used),
        )

    def _jump(self, state: State) -> State:
        """Instant motion: at the target by the end of the step."""
        place = rows(self.points, state.goal)
        state = state._replace(position=torch.cat([place, torch.zeros_like(place[..., :1])], -1))
        if not self.config.battery.enabled:
            return state
        length = self._length(state.origin, state.goal)
        return self._drain_or_charge(state, self._drain(length), length == 0)

    def _fly(self, state: State) -> State:
        """Polynomial motion: ``dt`` of takeoff, cruise and landing."""
        elapsed = state.elapsed + self.dt
        position, cruised = fly(
            rows(self.points, state.origin),
            rows(self.points, state.goal),
            self.levels,
            elapsed,
            state.vertical,
            state.cruise,
            self.config.motion.degree,
        )
        state = state._replace(elapsed=elapsed, position=position)
        if not self.config.battery.enabled:
            return state
        used = used_so_far(elapsed, state.vertical, state.cruise, cruised, self.config.battery)
        landed_before = elapsed - self.dt >= self._duration(state) - _TIME_EPS
        drained = self._drain_or_charge(state, used - state.used, landed_before)
        return drained._replace(used=used)

    def _sense(self, state: State, acts: Tensor | None = None) -> State:
        """Move the source, listen, and send messages."""
        now = (state.steps * self.dt).to(state.track.dtype)
        place, emits, over = self._source(state, now)
        talks = self.landed(state) if self.flies else torch.ones_like(state.talks)
        position = state.position[..., :2]
        apart = (position - place.unsqueeze(-2)).square().sum(-1)
        spotted = talks & emits.unsqueeze(-1) & (apart <= self.radius**2)
        times = now.unsqueeze(-1).repeat(1, state.track.shape[-1])
        message = Snapshot(
            time=times,
            position=position,
            target=rows(self.points, state.goal),
            track=state.track,
            battery=state.battery,
            spotted=spotted,
            motions=state.motions,
            detected_time=torch.where(spotted, times, state.sent.detected_time),
            detected_position=torch.where(spotted.unsqueeze(-1), position, state.sent.detected_position),
            trail=self._trail(state, talks, acts),
        )
        return state._replace(
            source=place,
            source_over=over,
            talks=talks,
            motions=torch.where(spotted, 0, state.motions),
            sent=where(talks, message, state.sent) if self.flies else message,
        )

    # Parts.

    def _trail(self, state: State, talks: Tensor, acts: Tensor | None) -> Tensor:
        """The latest landing points, one for each decision, however long the UAV then senses there."""
        longer = torch.cat([state.goal.unsqueeze(-1), state.sent.trail[..., :-1]], -1)
        if not self.flies:
            return longer if acts is None else torch.where(acts.unsqueeze(-1), longer, state.sent.trail)
        waited = (state.elapsed > self.dt + _TIME_EPS) & state.talks
        return torch.where((talks & ~waited).unsqueeze(-1), longer, state.sent.trail)

    def _source(self, state: State, now: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Where the source is [B, 2], whether it emits [B], and whether its walk is over [B]."""
        config = self.config.source
        emits = torch.ones_like(state.source_over)
        if config.motion == "static":
            place, over = state.source, state.source_over
        else:
            walk = tree_map(lambda t: t.index_select(0, state.situation), self.walk)
            place, stop, over = locate(walk, now)
            if config.emission == "per_stop":
                emits = walk.emits.gather(-1, stop.unsqueeze(-1)).squeeze(-1)
        if config.emission == "per_step":
            chance = counter_rng.uniform(state.seed, state.episode, state.steps)
            emits = chance < config.emission_probability
        return place, emits & ~over, over

    def _duration(self, state: State) -> Tensor:
        return 2 * state.vertical + state.cruise

    def _length(self, origin: Tensor, goal: Tensor) -> Tensor:
        """Distance between landing points by flat id [m]."""
        return torch.linalg.vector_norm(rows(self.points, goal) - rows(self.points, origin), dim=-1)

    def _shortest(self, length: Tensor) -> Tensor:
        """Duration of a phase of this length [s]."""
        motion = self.config.motion
        return minimum_time(length, motion.degree, motion.max_speed, motion.max_acceleration)

    def _drain(self, length: Tensor) -> Tensor:
        """Battery that a flight of this length takes with takeoff and landing [%]; 0 for holding."""
        return flight_drain(self.vertical, length, self.config.battery) * (length > 0)

    def _drain_or_charge(self, state: State, drain: Tensor, rests: Tensor) -> State:
        gain = self.charge * (rests & rows(self.chargers, state.goal))
        return state._replace(battery=(state.battery - drain + gain).clamp(0, 100))

    def _begin(self, region: Tensor, start: Tensor, seed: int) -> State:
        """The state at time 0 of every situation, [Q, ...]: what resets copy from."""
        n = len(region)
        goal = start + region.unsqueeze(-1) * self.airspace.max_points
        number = torch.arange(n)
        count, zeros = torch.zeros_like(goal), torch.zeros(goal.shape)
        place = rows(self.points, goal)
        sent = Snapshot(
            time=zeros,
            position=place,
            target=place,
            track=zeros,
            battery=zeros + 100,
            spotted=zeros.bool(),
            motions=count,
            detected_time=zeros - 1,
            detected_position=torch.zeros_like(place),
            trail=goal.unsqueeze(-1).repeat(1, 1, self.config.observation.window),
        )
        state = State(
            seed=counter_rng.world_seeds(seed, n),
            episode=torch.zeros_like(number),
            situation=number,
            region=region,
            steps=torch.zeros_like(number),
            origin=goal,
            goal=goal,
            elapsed=zeros + self.config.motion.sensing_time,
            vertical=zeros,
            cruise=zeros,
            used=zeros,
            position=torch.cat([place, zeros.unsqueeze(-1)], -1),
            track=zeros,
            battery=zeros + 100,
            motions=count,
            source=self.walk.stop[:, 0],
            source_over=torch.zeros_like(number, dtype=torch.bool),
            talks=torch.ones_like(goal, dtype=torch.bool),
            sent=sent,
        )
        return self._sense(state)


def _draw_situations(
    config: ScenarioConfig, airspace: Airspace, rng: np.random.Generator
) -> tuple[Tensor, Tensor, Walk]:
    """Region [Q], start point of each UAV [Q, N] and source walk [Q, K] of every situation."""
    per_region = config.region.situations // len(airspace.regions)
    walks, starts = [], []
    for index, region in enumerate(airspace.regions):
        walks.append(draw_walks(region.polygon, config.source, per_region, rng))
        starts.append(_draw_starts(config, airspace, index, per_region, rng))
    stops = max(walk.arrive.shape[1] for walk in walks)
    region = torch.arange(len(airspace.regions)).repeat_interleave(per_region)
    longer = [_longer(walk, stops) for walk in walks]
    return region, torch.cat(starts), tree_map(lambda *rows: torch.cat(rows), *longer)


def _longer(walk: Walk, stops: int) -> Walk:
    """Pad a walk with stops that it never reaches."""
    missing = stops - walk.arrive.shape[1]

    def pad(field: Tensor) -> Tensor:
        last = field[:, -1:]
        return torch.cat([field, last.expand(-1, missing, *last.shape[2:])], 1)

    never = walk.arrive.new_full((len(walk.arrive), missing), torch.inf)
    return tree_map(pad, walk)._replace(arrive=torch.cat([walk.arrive, never], 1))


def _draw_starts(
    config: ScenarioConfig, airspace: Airspace, region: int, n: int, rng: np.random.Generator
) -> Tensor:
    """Start points of the UAVs, [n, N]: given, together on one point, or all on different ones."""
    if config.region.start_positions is not None:
        place = torch.tensor(config.region.start_positions)
        within = inside(airspace.edges[region], place)
        if not within.all():
            outside = place[~within][0].tolist()
            raise InputError(f"region.start_positions: {outside} m lies outside the region")
        points = nearest_points(airspace.points[region], place, 1).squeeze(-1)
        return points.expand(n, -1).clone()
    n_points = int(airspace.n_points[region])
    if config.region.start_together:
        return torch.as_tensor(rng.integers(n_points, size=(n, 1))).repeat(1, config.agents)
    keys = torch.as_tensor(rng.random((n, n_points)))
    return keys.topk(config.agents, dim=-1).indices


def _chargers(config: ScenarioConfig, airspace: Airspace) -> Tensor:
    """At which landing points UAVs charge, [R*L] bool."""
    places = config.battery.charging_points
    n_regions, n_points = airspace.points.shape[:2]
    if places is None:
        return torch.ones(n_regions * n_points, dtype=torch.bool)
    nearest = nearest_points(airspace.points.unsqueeze(1), torch.tensor(places), 1).squeeze(-1)
    flat = nearest + n_points * torch.arange(n_regions).unsqueeze(-1)
    return torch.zeros(n_regions * n_points, dtype=torch.bool).index_fill(0, flat.flatten(), True)
