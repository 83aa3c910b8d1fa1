"""The physics of B parallel worlds: decisions, flights, the source, and the messages that the UAVs
send."""

import math
from typing import Any

import numpy as np
import torch
from numpy.random import Generator
from scipy.spatial import KDTree
from torch import Tensor

from damian.common import checks, counter_rng
from damian.common.tensors import (
    gather_rows,
    move_attributes,
    tree_map,
    tree_where,
    where_rows,
)
from damian.world.airspace import Airspace, build_airspace
from damian.world.battery import observed
from damian.world.config import WorldConfig
from damian.world.landing import Candidates, Ranking, assign_landing_points
from damian.world.messages import Messages, Widths
from damian.world.news import News, draw
from damian.world.regions.region import local_places
from damian.world.regions.sources import regions_of
from damian.world.requests import appear, poisson_arrivals, serve
from damian.world.sensors import sensors_of
from damian.world.signal_source import Walk, draw_walks, drawn_radius, footprint_radius, locate
from damian.world.state import EPISODE, INITIAL_CONDITION, SEED, PackedState, State, StateLayout
from damian.world.vehicles import MOTION_MODELS

_REPORT = counter_rng.number_of("report")
_SOURCE = counter_rng.number_of("source")


class Simulation:
    """The worlds' constants, regions and walks, drawn on the CPU, and functions of their state."""

    foretold = False
    """Whether nothing happens that messages do not tell: no flight is aborted, and no UAV fails."""

    def __init__(self, config: WorldConfig, dt: float, stops: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.config = config
        self.dt = dt
        self.sensors = sensors_of(config.sensors)
        self.sources = config.source.all
        self.reach = torch.tensor([footprint_radius(source) for source in self.sources])
        """Largest distance at which UAVs detect each source [m], [K]."""
        self.radius = footprint_radius(config.source)
        """Radius of a footprint [m]."""
        n_readings = sum(each.width for each in self.sensors.values())
        n_sources = len(self.sources)
        n_requests = config.requests.slots
        n_truths = n_sources if config.tells_truth else 0
        n_events = n_sources * config.seeks_source + (n_requests > 0)
        n_events *= config.tells_events
        self.widths = Widths(
            n_sources,
            n_readings,
            n_requests,
            n_truths,
            n_events,
            int(config.tells_commands),
            config.announced,
            config.pending,
        )
        regions = regions_of(config.region, rng)
        longest = max(config.actions.distances)
        self.airspace = build_airspace(regions, config.region, config.agents, longest)
        self.candidates = Candidates(self.airspace, config.actions, config.agents)
        self.news = News(config, self.candidates, dt)
        region, start, self.walks = _draw_initial_conditions(config, self.airspace, rng)
        model = MOTION_MODELS.get(config.motion.kind, "motion.kind")
        self.vehicles = model(config, self.airspace, dt)
        self.points = self.airspace.points.flatten(0, 1)
        if n_requests:
            mean = config.requests.rate * dt / 60
            self.arrivals = poisson_arrivals(regions, n_requests, mean, rng)
        self.misses = torch.tensor([source.miss for source in self.sources])
        """Probability that a UAV in reach of each source does not report it, [K]."""
        self.false_alarms = torch.tensor([source.false_alarm for source in self.sources])
        """Probability that a UAV out of its reach does, [K]."""
        pairs = torch.arange(config.agents * n_sources)
        self.pairs = pairs.view(config.agents, -1)
        """Numbers of the pairs of a UAV and a source, [N, K]; made within a step, they would not
        compile."""
        choices = self.vehicles.values.choices
        drawn = {"source.miss", "source.false_alarm"} & {*choices}
        self.unsure = bool(drawn) or any(each.miss or each.false_alarm for each in self.sources)
        """Whether reports about a source may be wrong."""
        self.draws = bool(self.sensors or choices or self.unsure)
        """Whether first messages differ from episode to episode that begins alike."""
        shortest = self._shortest_flights()  # refuses actions that lead nowhere
        self.shortest_flight = shortest if config.battery.enabled else None
        """Length of the shortest flight from each landing point [m], [R*L]; None without
        batteries."""
        self.initial = self._initial_state(region, start, stops, seed)
        self.layout = StateLayout(self.initial)
        self.packed_initial = self.layout.pack(self.initial)

    def __getstate__(self) -> dict[str, Any]:
        """The state without the sensors: pickle does not find a function behind its decorator."""
        return self.__dict__ | {"sensors": {}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.sensors = sensors_of(self.config.sensors)

    def to(self, device: torch.device) -> "Simulation":
        """Move all tensors to a device, in place."""
        for owner in (self, self.candidates, self.vehicles, self.news):
            move_attributes(owner, device)
        return self

    def reset(self, worlds: PackedState, mask: Tensor) -> PackedState:
        """Begin a new episode in the worlds of the mask [B]; the others stay as they are."""
        chosen = mask.nonzero().squeeze(-1)  # usually few worlds
        ended = tree_map(lambda rows: rows.index_select(0, chosen), worlds)
        fresh = self.next_episode(ended)
        return tree_map(lambda old, new: old.index_copy(0, chosen, new), worlds, fresh)

    def next_episode(self, worlds: PackedState) -> PackedState:
        """Begin a new episode in all of the given worlds."""
        seed = worlds.integers[:, SEED]
        episode = worlds.integers[:, EPISODE] + 1
        n_conditions = len(self.initial.initial_condition)
        condition = counter_rng.bits(seed, episode) % n_conditions
        kept = torch.stack([seed, episode, condition], 1)  # the first three columns
        condition = kept[:, INITIAL_CONDITION]  # or else a graph computes it anew for every column
        fresh = tree_map(lambda table: table.index_select(0, condition), self.packed_initial)
        others = fresh.integers[:, kept.shape[1] :]
        fresh = fresh._replace(integers=torch.cat([kept, others], 1))
        if not self.draws:
            return fresh
        state = self.layout.unpack(fresh)  # the first messages tell what is drawn for this episode
        drawn = self.vehicles.values.draw(state.seed, state.episode)
        state = self._first_messages(state._replace(drawn=drawn))
        return self.layout.pack(state)

    def step(
        self,
        state: State,
        action: Tensor,
        action_valid: Tensor | None = None,
        command: Tensor | None = None,
    ) -> State:
        """Simulate one step; actions of UAVs that are not ready change nothing.

        Actions are discrete [B, N], or continuous [B, N, 2] in [0, 1]; only those of
        ``action_valid`` [B, N] count. They begin where each UAV stands, or else as ``command``
        [B, N, 1 + K, 3] says (``damian.keys``).
        """
        decided = self.decide(state, action, action_valid, command)
        if self.news.aborts and not self.foretold:
            decided = self._abort(state, decided)
        moved = self.vehicles.move(decided)
        moved = moved._replace(steps=state.steps + 1)
        if self.foretold or not self.news.fails:
            return self._sense(moved, action_valid)
        moved = self.news.fail(moved)
        return self._sense(moved, action_valid, state.failed & ~moved.failed)

    def action_mask(self, state: State) -> Tensor:
        """Legal discrete actions, [B, N, A] bool; a UAV that is not ready has one, which holds."""
        return self.legal(self._action_distances(state), self.vehicles.reach(state))

    def legal(self, distance: Tensor, reach: Tensor) -> Tensor:
        """The same by the lengths of the actions [m], [B, N, A], and how far each UAV may fly now
        [m], [B, N]."""
        reach = reach.unsqueeze(-1)
        valid = distance <= reach
        if not self.candidates.can_hold:
            stuck = ~valid.any(-1, keepdim=True)
            valid = valid | stuck
        if self.vehicles.instant and not self.news.fails:
            return valid
        return torch.where(reach >= 0, valid, self.candidates.hold)

    def _action_distances(self, state: State) -> Tensor:
        """Lengths of the discrete actions for the batteries [m], infinite outside the region,
        [B, N, A]."""
        distance = gather_rows(self.candidates.distance, state.goal)
        if not self.vehicles.is_windy:
            return distance
        nearest = gather_rows(self.candidates.nearest, state.goal)
        return self._distance_to(state, nearest).where(distance.isfinite(), torch.inf)

    def _distance_to(self, state: State, goals: Tensor) -> Tensor:
        """Lengths for the batteries of flights to these flat ids [m], [B, N, K]."""
        origin = state.goal.unsqueeze(-1).expand_as(goals)
        return self.vehicles.distance(state, origin, goals)

    def bound_for(self, messages: Messages) -> Tensor:
        """The landing points on which UAVs stand, or to which they fly, flat ids [B, N]."""
        if self.vehicles.instant:
            return messages.trail[..., 0]
        region = messages.region(self.airspace.max_points)
        return messages.bound_for(self.airspace.points, region)

    # The stages of one step, in order.

    def decide(
        self,
        state: State,
        action: Tensor,
        action_valid: Tensor | None,
        command: Tensor | None = None,
    ) -> State:
        """Assign landing points to the UAVs that may choose, and start their flights, as in
        ``step``."""
        origin = state.goal
        if command is not None:
            start, number, _ = command[..., 0, :].unbind(-1)
            origin = torch.where(number > 0, start, origin)
        ranking, row = self.candidates.rank(origin, state.region, action)
        if self.vehicles.is_windy or command is not None:
            ranking, row = self._from_here(state, ranking, row)
        reach = self.vehicles.reach(state)
        if action_valid is not None:
            reach = torch.where(action_valid, reach, -1.0)
        ready = reach >= 0
        goal, departs, state = self._assigned(state, ranking, row, reach, state.goal)
        state = state._replace(motions=state.motions + ready)
        if command is not None:
            state = state._replace(sent=self._with_commands(state, command, ready))
        return self.vehicles.take_off(state, goal, ready, departs)

    def _assigned(
        self, state: State, ranking: Ranking, row: Tensor, reach: Tensor, start: Tensor
    ) -> tuple[Tensor, Tensor, State]:
        """The landing points to which UAVs fly next, flat ids, which of them are others than
        before, [B, N] each, and the state with the headings of flights to these from ``start``."""
        n_points = self.airspace.max_points
        base = state.region.unsqueeze(-1) * n_points
        standing = state.goal - base
        goal = assign_landing_points(ranking, row, standing, reach, n_points) + base
        turns = goal != state.goal
        track = torch.where(turns, self._heading(start, goal), state.track)
        return goal, turns, state._replace(track=track)

    def _with_commands(self, state: State, command: Tensor, ready: Tensor) -> Messages:
        """The latest messages, in which UAVs tell what they have executed, and what is under
        way."""
        number = command[..., 0, 1:2].to(state.track.dtype)
        executed = where_rows(ready, number, state.sent.executed)
        commands = command[..., 1 : self.widths.announced + 1, :]
        point, number, latest = commands.unbind(-1)
        under_way = (number > executed) & (latest > state.steps.view(-1, 1, 1) + 1)
        by = (latest * self.dt).to(executed.dtype).unsqueeze(-1)
        told = torch.cat([gather_rows(self.points, point), by, torch.ones_like(by)], -1)
        announced = told * under_way.unsqueeze(-1)
        return state.sent._replace(executed=executed, announced=announced)

    def _from_here(self, state: State, ranking: Ranking, row: Tensor) -> tuple[Ranking, Tensor]:
        """The ranking of each UAV with distances from where it stands, as the wind makes them.

        Its own point is the last candidate: about another point, all others may be taken.
        """
        point = gather_rows(ranking.point, row).long()  # [B, N, K]
        base = state.region * self.airspace.max_points
        flat = torch.cat([point + base.view(-1, 1, 1), state.goal.unsqueeze(-1)], -1)
        point = flat - base.view(-1, 1, 1)
        return Ranking.of_each(point, self._distance_to(state, flat))

    def _heading(self, origin: Tensor, goal: Tensor) -> Tensor:
        """Heading from landing points to others, flat ids, clockwise from north [rad], [B, N]."""
        east, north = (gather_rows(self.points, goal) - gather_rows(self.points, origin)).unbind(-1)
        return torch.remainder(torch.atan2(east, north), 2 * math.pi)

    def _abort(self, before: State, state: State) -> State:
        """Let some of the flights that may turn in this step end elsewhere.

        Each takes one of the landing points to which a legal action leads and no other UAV stands
        or flies, nor was commanded in this step, all of them as likely; its own, if there is none.
        """
        start, reach = self.vehicles.approach(state, state.motions > before.motions)
        chance = self.vehicles.values.get("motion.abort", state.drawn)
        reach = torch.where(self.news.abort(state, chance), reach, -1.0)
        distance = self._action_distances(state._replace(goal=start))
        distance = distance.where(distance <= reach.unsqueeze(-1), torch.inf)
        ranking, row = self.news.elsewhere(state, start, distance)
        goal, turns, state = self._assigned(state, ranking, row, reach, start)
        return self.vehicles.divert(state, goal, turns)

    def _sense(
        self, state: State, action_valid: Tensor | None = None, joins: Tensor | None = None
    ) -> State:
        """Move the source, let UAVs on the ground detect it, and send messages; ``joins`` [B, N]:
        UAVs that have failed before."""
        now = (state.steps * self.dt).to(state.track.dtype)
        place, emits, over = self.source_now(state)
        state = state._replace(source=place, source_over=over.all(-1))
        on_ground = self.vehicles.on_ground(state) & ~state.failed
        in_reach = self.in_reach(state, emits, on_ground)
        detected = self._reported(state, in_reach, on_ground.unsqueeze(-1))
        times = now.unsqueeze(-1).repeat(1, state.track.shape[-1])
        stops = self.vehicles.new_stop(state, on_ground, action_valid)
        if stops is not None and joins is not None:
            stops = (stops | joins) & on_ground
        lands = on_ground if stops is None else stops
        state, served, serves = self._serve(state, now, lands)
        happens = self._events(detected, serves)
        trail, landed, events = self._stops(state, times, happens, stops)
        sent = state.sent
        position = state.position[..., :2]
        known = sent.detected_time, sent.detected_position
        detected_time, detected_position = _last_found(detected, times, position, known)
        found = detected
        true = sent.true_time, sent.true_position
        if self.widths.truths:
            found = in_reach
            true = _last_found(in_reach, times, position, true)
        motions = torch.where(found.any(-1), 0, state.motions)
        messages = Messages(
            time=times,
            position=position,
            target=gather_rows(self.points, state.goal),
            track=state.track,
            battery=state.battery,
            spotted=detected.any(-1),
            empty=self._empty(state, on_ground),
            motions=state.motions,
            detected_time=detected_time,
            detected_position=detected_position,
            true_time=true[0],
            true_position=true[1],
            requests=self._heard(state, on_ground),
            served=served,
            serves=serves,
            executed=sent.executed,
            announced=sent.announced,
            pending=sent.pending,
            trail=trail,
            landed=landed,
            events=events,
            readings=self._readings(state),
        )
        sends, sent = self.vehicles.latest_messages(state, on_ground, messages)
        if self.news.fails:
            sends = sends & ~state.failed
            sent = tree_where(state.failed, state.sent, sent)
        if self.config.requests.known_at_once:
            sent = sent._replace(requests=messages.requests)
        return state._replace(message_sent=sends, motions=motions, sent=sent)

    def radii(self, state: State, settings: float | Tensor) -> float | Tensor:
        """Radius of the footprints of each world's UAVs [m], [B, 1, 1], if it is drawn; else as in
        the settings."""
        level = self.vehicles.values.get("source.level_db", state.drawn)
        if isinstance(level, Tensor):
            return drawn_radius(level.unsqueeze(-1), self.config.source)
        return settings

    def in_reach(self, state: State, emits: Tensor, on_ground: Tensor) -> Tensor:
        """Whether UAVs ``on_ground`` [B, N] are within the radius of sources that emit [B, K];
        [B, N, K]."""
        ways = state.position[..., None, :2] - state.source.unsqueeze(-3)
        near = ways.square().sum(-1) <= self.radii(state, self.reach) ** 2
        hears = on_ground.unsqueeze(-1) & emits.unsqueeze(-2)
        return hears & near

    def _reported(self, state: State, in_reach: Tensor, listens: Tensor) -> Tensor:
        """What each UAV reports of each source; some in reach miss it, some out of reach raise an
        alarm."""
        if not self.unsure:
            return in_reach
        miss = self._chance("source.miss", state, self.misses)
        alarm = self._chance("source.false_alarm", state, self.false_alarms)
        share = draw(state, _REPORT, self.pairs)
        return torch.where(in_reach, share >= miss, listens & (share < alarm))

    def _chance(self, key: str, state: State, settings: Tensor) -> Tensor:
        """A probability that is drawn for each world, [B, 1, 1], or that of each source, [K]."""
        drawn = self.vehicles.values.get(key, state.drawn)
        return drawn.unsqueeze(-1) if isinstance(drawn, Tensor) else settings

    def _events(self, detected: Tensor, serves: Tensor) -> Tensor:
        """What happens at a stop that begins now, as in ``Messages``, [B, N, E]."""
        if not self.widths.events:
            return serves[..., :0]
        heard = detected if self.config.seeks_source else detected[..., :0]
        return torch.cat([heard.to(serves.dtype), serves], -1)

    def _stops(
        self, state: State, now: Tensor, events: Tensor, added: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Landing points and times [s] of each UAV's latest stops, newest first, [B, N, S] each,
        and what happened there, [B, N, S, E]."""
        sent = state.sent
        newest = state.goal, now, events
        before = sent.trail, sent.landed, sent.events
        found = []
        for new, old in zip(newest, before, strict=True):
            stops = torch.cat([new.unsqueeze(2), old[:, :, :-1]], 2)
            found.append(stops if added is None else where_rows(added, stops, old))
        trail, landed, happened = found
        return trail, landed, happened

    def _serve(self, state: State, now: Tensor, lands: Tensor) -> tuple[State, Tensor, Tensor]:
        """Let requests appear, and the UAVs that land serve some, as in ``Messages``."""
        served = state.sent.served
        serves = state.sent.serves
        if not self.widths.requests:
            return state, served, serves
        requests = self._appear(state, now)
        place = state.position[..., :2]
        radius = self.radii(state, self.radius)
        served, serves = serve(requests, served, place, lands, radius)
        serves = serves.unsqueeze(-1).to(now.dtype)
        return state._replace(requests=requests), served, serves

    def _appear(self, state: State, now: Tensor) -> Tensor:
        """The requests of each slot after some may have appeared, [B, M, 3]."""
        counters = state.seed, state.episode, state.steps, state.region
        return appear(state.requests, state.sent.served, self.arrivals, counters, now)

    def _heard(self, state: State, on_ground: Tensor) -> Tensor:
        """The latest request of each slot that each UAV knows, [B, N, M, 3]."""
        requests = state.requests.unsqueeze(-3)
        reach = self.config.requests.range
        if reach is None:  # everybody knows of all
            return requests.expand(-1, on_ground.shape[-1], -1, -1)
        ways = requests[..., :2] - state.position[..., None, :2]
        near = ways.square().sum(-1) <= reach**2
        return where_rows(on_ground.unsqueeze(-1) & near, requests, state.sent.requests)

    def _empty(self, state: State, on_ground: Tensor) -> Tensor:
        """Whether each UAV's observed battery level is 0, or allows nothing but holding, [B, N]."""
        if self.shortest_flight is None:
            return state.sent.empty
        reach = self.vehicles.battery_reach(state)
        if self.vehicles.is_windy:
            shortest = self._shortest_in_wind(state)
        else:
            shortest = gather_rows(self.shortest_flight, state.goal)
        stuck = on_ground & (reach < shortest)
        return stuck | (observed(state.battery, self.config.battery) <= 0)

    def _shortest_flights(self) -> Tensor:
        """Length of the shortest flight from each landing point [m], 0 if no action flies, [R*L].

        Actions are refused if none of them leads from any landing point to another one.
        """
        actions = self.config.actions
        if actions.kind == "discrete":
            length = self.candidates.distance  # if this point is out of reach, the UAV holds
            length = length.where(length > 0, torch.inf).amin(-1)
            longest = torch.inf
        else:  # a landing point is nearest beyond half of the way to it
            nearest = [_nearest_other(points) for points in self.airspace.points]
            length = torch.cat(nearest)
            longest = 2 * self.candidates.max_distance
        flies = bool((length < longest).any())
        checks.require(
            flies or self.airspace.max_points == 1,
            "actions.distances",
            actions.distances,
            "[m] lead from no landing point to another one: take larger ones, or a finer lattice",
        )
        return length.where(length.isfinite(), 0.0)

    def _shortest_in_wind(self, state: State) -> Tensor:
        """As ``shortest_flight`` for each UAV, as long as the flights are for the batteries now,
        [B, N]."""
        if self.config.actions.kind == "discrete":
            length = self._action_distances(state)
        else:
            n_points = self.airspace.max_points
            point = torch.arange(n_points, device=state.goal.device)
            base = state.region.unsqueeze(-1) * n_points
            goals = (base + point).unsqueeze(1)  # [B, 1, L]
            goals = goals.expand(-1, state.goal.shape[-1], -1)
            origin = state.goal.unsqueeze(-1).expand_as(goals)
            straight = self.airspace.length(origin, goals)
            near = straight < 2 * self.candidates.max_distance  # false for padded points
            goals = torch.where(near, goals, origin)
            length = self.vehicles.distance(state, origin, goals)
        shortest = length.where(length > 0, torch.inf).amin(-1)
        return shortest.where(shortest.isfinite(), 0.0)

    def _readings(self, state: State) -> Tensor:
        """Readings of all sensors beside each other, [B, N, K]."""
        if not self.sensors:
            return state.sent.readings
        readings = [sensor.read(state, self) for sensor in self.sensors.values()]
        return torch.cat(readings, -1)

    def source_now(self, state: State) -> tuple[Tensor, Tensor, Tensor]:
        """Positions of the sources [B, K, 2], whether they emit and whether their walks are over,
        [B, K]."""
        found = [self._source_now(state, number) for number in range(len(self.sources))]
        place, emits, over = zip(*found, strict=True)
        return torch.stack(place, 1), torch.stack(emits, 1), torch.stack(over, 1)

    def _source_now(self, state: State, number: int) -> tuple[Tensor, Tensor, Tensor]:
        """The same of one source, [B, 2] and [B]."""
        config = self.sources[number]
        seed = state.seed
        if number:
            seed = counter_rng.bits64(seed, _SOURCE, number)
        emits = torch.ones_like(state.source_over)
        if config.motion == "static":
            place = state.source[:, number]
            over = torch.zeros_like(state.source_over)
        else:
            condition = state.initial_condition
            walk = tree_map(lambda t: t.index_select(0, condition), self.walks[number])
            time = state.steps.double() * self.dt
            place, stop, tour, over = locate(walk, time, config.after_walk == "loop")
            if config.emission == "per_stop":
                first = walk.emits.gather(-1, stop.unsqueeze(-1)).squeeze(-1)
                draw = counter_rng.uniform(seed, state.episode, tour, stop)
                later = draw < config.emission_probability
                emits = torch.where(tour == 0, first, later)
        if config.emission == "per_step":
            draw = counter_rng.uniform(seed, state.episode, state.steps)
            emits = draw < config.emission_probability
        return place, emits & ~over, over

    def _initial_state(self, region: Tensor, start: Tensor, stops: int, seed: int) -> State:
        """The state at time 0 of every initial condition, [Q, ...]; resets copy rows of it."""
        n = len(region)
        base = region.unsqueeze(-1) * self.airspace.max_points
        goal = start + base
        number = torch.arange(n)
        none = torch.zeros_like(number)
        zeros = torch.zeros(goal.shape)
        place = gather_rows(self.points, goal)
        sensing_steps = math.ceil(self.config.motion.sensing_time / self.dt)
        seeds = counter_rng.world_seeds(seed, n)
        trail = goal.unsqueeze(-1).repeat(1, 1, stops)
        state = State(
            seed=seeds,
            episode=none,
            initial_condition=number,
            region=region,
            steps=none,
            origin=goal,
            goal=goal,
            elapsed=torch.full_like(goal, sensing_steps + 1),
            vertical=zeros,
            cruise=zeros,
            cruise_before=zeros,
            air=zeros,
            battery_before=zeros + 100,
            position=torch.cat([place, zeros.unsqueeze(-1)], -1),
            track=zeros,
            battery=zeros + 100,
            failed=torch.zeros_like(goal, dtype=torch.bool),
            motions=torch.zeros_like(goal),
            source=torch.stack([walk.stop[:, 0] for walk in self.walks], 1),
            source_over=torch.zeros_like(number, dtype=torch.bool),
            requests=torch.full((n, self.widths.requests, 3), -1.0),
            drawn=self.vehicles.values.draw(seeds, none),
            message_sent=torch.ones_like(goal, dtype=torch.bool),
            sent=Messages.blank(trail, self.widths),
        )
        return self._first_messages(state)

    def _first_messages(self, state: State) -> State:
        """The state at the beginning of episodes with the messages that the UAVs send then."""
        blank = Messages.blank(state.sent.trail, self.widths)
        state = self._sense(state._replace(sent=blank))
        landed = state.sent.landed
        stop = torch.arange(landed.shape[-1], device=landed.device)
        times = torch.where(stop == 0, 0.0, -1.0)  # nothing is known of before
        sent = state.sent._replace(landed=times.expand_as(landed))
        return state._replace(sent=sent)


def _last_found(
    found: Tensor, time: Tensor, place: Tensor, before: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """When and where UAVs have last found each source, [B, N, K] and [B, N, K, 2], if ``found``
    [B, N, K] says whether they do at this time [B, N] and place [B, N, 2]."""
    last_time, last_place = before
    last_time = torch.where(found, time.unsqueeze(-1), last_time)
    last_place = where_rows(found, place.unsqueeze(-2), last_place)
    return last_time, last_place


def _draw_initial_conditions(
    config: WorldConfig, airspace: Airspace, rng: Generator
) -> tuple[Tensor, Tensor, tuple[Walk, ...]]:
    """Draw Q initial conditions, the same number for each region, on the CPU.

    Returns the index of the region, [Q], the landing point of each UAV within it, [Q, N], and the
    walk of each source over at most S stops, [Q, S].
    """
    per_region = config.region.initial_conditions // len(airspace.regions)
    sources = config.source.all
    walks = [[] for _ in sources]
    starts = []
    for index, region in enumerate(airspace.regions):
        for source, drawn in zip(sources, walks, strict=True):
            start = None
            if source.position is not None:
                start = local_places("source.position", [source.position], region)[0]
            walk = draw_walks(region.polygon, source, per_region, rng, start)
            drawn.append(walk)
        start = _draw_starts(config, airspace, index, per_region, rng)
        starts.append(start)
    indices = torch.arange(len(airspace.regions)).repeat_interleave(per_region)
    return indices, torch.cat(starts), tuple(map(_joined, walks))


def _joined(walks: list[Walk]) -> Walk:
    """The walks of one source in all regions, padded by stops that it never reaches."""
    stop = torch.arange(max(walk.arrive.shape[1] for walk in walks))
    padded = []
    for walk in walks:
        last = walk.arrive.shape[1] - 1
        kept = stop.clamp(max=last)
        longer = tree_map(lambda field, kept=kept: field[:, kept], walk)
        arrive = longer.arrive.masked_fill(stop > last, torch.inf)
        padded.append(longer._replace(arrive=arrive))
    return tree_map(lambda *parts: torch.cat(parts), *padded)


def _draw_starts(
    config: WorldConfig, airspace: Airspace, region: int, n: int, rng: Generator
) -> Tensor:
    """Landing points where the UAVs start, [n, N]: the given ones, one for all UAVs, or one for
    each."""
    key = "region.start_positions"
    given = config.region.start_positions
    together = config.region.start_together
    n_points = int(airspace.n_points[region])
    if given is None and together:
        point = torch.as_tensor(rng.integers(n_points, size=(n, 1)))
        return point.repeat(1, config.agents)
    if given is None:
        order = torch.as_tensor(rng.random((n, n_points)))
        return order.topk(config.agents, dim=-1).indices
    home = airspace.regions[region]
    points = airspace.nearest(local_places(key, given, home), region)
    problem = (
        f"lead to the same landing point of {home.name}: take others, or region.start_together=true"
    )
    distinct = len(points.unique()) == len(points)
    checks.require(together or distinct, key, given, problem)
    return points.expand(n, -1).clone()


def _nearest_other(points: Tensor) -> Tensor:
    """Distance from each landing point [L, 2] to the nearest other one [m], [L]; infinite for
    padded ones."""
    distance = torch.full((len(points),), torch.inf)
    real = points.isfinite().all(-1)
    places = points[real].double().numpy()
    nearest, _ = KDTree(places).query(places, k=2)  # the first one is the point itself
    distance[real] = torch.as_tensor(nearest[:, 1]).float()
    return distance
