"""Motion models: how UAVs move between landing points, how long this takes, and how batteries
change."""

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor

from damian.common import checks, counter_rng
from damian.common.errors import InputError
from damian.common.registry import Registry
from damian.common.tensors import gather_rows, tree_where, where_rows
from damian.world.airspace import Airspace
from damian.world.battery import (
    battery_of,
    charge_gain,
    cruise_drain,
    cruise_range,
    flight_drain,
    used_so_far,
    vertical_drain,
)
from damian.world.config import WorldConfig
from damian.world.landing import displacement
from damian.world.messages import Messages
from damian.world.motion import air_length, flight_levels, minimum_time, poses
from damian.world.news import draw
from damian.world.regions.region import local_places
from damian.world.state import State
from damian.world.values import times, values_of

FLIGHT_LEVEL_M = 30.48
"""Metres per flight level of a published region (one flight level is 100 feet)."""

_GUST = counter_rng.number_of("gust")
_FLIGHT_ERROR = 1e-6
"""Largest relative error of the duration of a flight, which is computed in float32."""
_ROUNDING = 1e-12
"""Largest relative error of a number of steps, which is computed in double precision."""


class MotionModel(ABC):
    """Motion of N UAVs in B worlds with steps of ``dt`` seconds, as pure functions of their
    state."""

    instant: bool
    """Whether a UAV is at its target as soon as a step ends; if not, no two UAVs share a flight
    level."""

    def __init__(self, config: WorldConfig, airspace: Airspace, dt: float) -> None:
        self.motion = config.motion
        self.battery = config.battery
        self.dt = dt
        self.values = values_of(config)
        self.is_windy = config.is_windy
        self.airspace = airspace
        self.points = airspace.points.flatten(0, 1)
        levels = flight_levels(config.motion, config.agents, shared=self.instant)
        if not self.instant:
            check_levels(levels, airspace)
        self.levels = torch.tensor(levels)
        self.gusts = torch.arange(2 * config.agents).view(-1, 2)
        """Numbers of the two draws of each UAV's gust, [N, 2]; made within a step, they would not
        compile."""
        self.chargers = _charging_points(config, airspace)

    @abstractmethod
    def ready(self, state: State) -> Tensor:
        """Whether each UAV may choose an action now, [B, N] bool."""

    @abstractmethod
    def on_ground(self, state: State) -> Tensor:
        """Whether each UAV stands on its landing point, [B, N] bool."""

    @abstractmethod
    def take_off(self, state: State, goal: Tensor, ready: Tensor, departs: Tensor) -> State:
        """Start flights to ``goal`` of UAVs that have just chosen (``ready``) to fly (``departs``),
        [B, N].

        In the state's ``goal`` is where each stands or flies to.
        """

    @abstractmethod
    def move(self, state: State) -> State:
        """State with the positions and batteries after a step of ``dt``."""

    def approach(self, state: State, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Where each UAV may still turn to another landing point in the step that begins.

        Returns the landing points from which it would fly on, flat ids [B, N], and its longest
        cruise from there [m], [B, N]; negative if it may not. ``chosen`` [B, N] UAVs have just
        taken off, or hold.
        """
        return state.origin, torch.where(chosen, self.battery_reach(state), -1.0)

    def divert(self, state: State, goal: Tensor, turns: Tensor) -> State:
        """Let UAVs (``turns``) fly on from where they may, to ``goal``, [B, N]."""
        return self.take_off(state._replace(goal=state.origin), goal, turns, turns)

    @abstractmethod
    def latest_messages(
        self, state: State, on_ground: Tensor, messages: Messages
    ) -> tuple[Tensor, Messages]:
        """Which UAVs send a message in this step [B, N] bool, and the latest message of each UAV
        [B, N].

        ``state.sent`` are the latest ones before, ``messages`` what each would send.
        """

    @abstractmethod
    def new_stop(
        self, state: State, on_ground: Tensor, action_valid: Tensor | None
    ) -> Tensor | None:
        """Whether each UAV adds its landing point to its trail, [B, N] bool; None if all UAVs
        do."""

    def resumed(self, state: State, since: Tensor) -> State:
        """The state with the flights that ``state.sent`` tell of, sent ``since`` [B, N] steps.

        Raises:
            InputError: a model of a user's own does not say it.
        """
        should = "does not say how flights follow from messages (resumed): leave out forward"
        raise InputError(f"motion.kind={self.motion.kind}: it {should}")

    def reach(self, state: State) -> Tensor:
        """Longest cruise of each UAV now [m], [B, N]; 0: it can only hold; negative: it may not
        choose."""
        return torch.where(self.may_choose(state), self.battery_reach(state), -1.0)

    def may_choose(self, state: State) -> Tensor:
        """Whether each UAV is ready and has not failed, [B, N] bool."""
        return self.ready(state) & ~state.failed

    def battery_reach(self, state: State) -> Tensor:
        """Longest cruise that each battery allows [m], [B, N]; 0: it allows only holding."""
        if not self.battery.enabled:
            return torch.full_like(state.battery, checks.METRES)
        battery = battery_of(self.values, state.drawn)
        left = state.battery - vertical_drain(2 * self.vertical(state), battery)
        return cruise_range(left, battery).clamp(min=0)

    def distance(self, state: State, origin: Tensor, goal: Tensor) -> Tensor:
        """How long the flights between landing points are for the batteries [m], as far as can be
        foreseen.

        ``origin`` and ``goal`` are flat ids, [B, N, ...]; infinite where a UAV cannot fly.
        """
        return self.airspace.length(origin, goal)

    def shortest_time(self, length: Tensor, drawn: Tensor | None = None) -> Tensor:
        """Shortest duration [s] of a flight phase of each UAV of the given length [m], [*, N].

        ``drawn`` are the drawn values of the worlds, if there may be any.
        """
        if drawn is None:
            drawn = length.new_zeros(0)
        speed = self.values.get("motion.max_speed", drawn)
        acceleration = self.values.get("motion.max_acceleration", drawn)
        return minimum_time(length, self.motion.degree, speed, acceleration)

    def vertical(self, state: State) -> Tensor:
        """Duration of a takeoff, and of a landing, of each UAV [s], [N], or [B, N] if it is
        drawn."""
        return self.shortest_time(self.levels, state.drawn)

    def battery_after(
        self, state: State, level: Tensor, drain: Tensor, rested: Tensor, goal: Tensor
    ) -> Tensor:
        """Battery levels [%] after a flight and ``rested`` steps on the landing point ``goal``,
        [B, N]."""
        battery = battery_of(self.values, state.drawn)
        dt = level.new_full((), self.dt)
        charged = rested * gather_rows(self.chargers, goal)
        gain = charge_gain(dt, battery) * charged
        return (level - drain + gain).clamp(0, 100)


MOTION_MODELS = Registry[type[MotionModel]](
    "motion model",
    lambda found: isinstance(found, type) and issubclass(found, MotionModel),
    "is not a class derived from damian.world.vehicles.MotionModel",
)
"""Motion models by ``motion.kind``, or as ``package.module:Class``."""


@MOTION_MODELS.register("instant")
class InstantMotion(MotionModel):
    """A UAV is at its target when the step ends (paper, section 5: no action delay)."""

    instant = True

    def ready(self, state: State) -> Tensor:
        return torch.ones_like(state.message_sent)

    on_ground = ready

    def take_off(self, state: State, goal: Tensor, ready: Tensor, departs: Tensor) -> State:
        return state._replace(origin=state.goal, goal=goal)

    def resumed(self, state: State, since: Tensor) -> State:
        goal = state.sent.trail[..., 0]
        return state._replace(origin=goal, goal=goal)

    def move(self, state: State) -> State:
        place = gather_rows(self.points, state.goal)
        height = torch.zeros_like(place[..., :1])
        state = state._replace(position=torch.cat([place, height], -1))
        if not self.battery.enabled:
            return state
        length = self.airspace.length(state.origin, state.goal)
        battery = battery_of(self.values, state.drawn)
        flies = length > 0
        drain = flight_drain(self.vertical(state), length, battery) * flies
        level = self.battery_after(state, state.battery, drain, length == 0, state.goal)
        return state._replace(battery=level)

    def latest_messages(
        self, state: State, on_ground: Tensor, messages: Messages
    ) -> tuple[Tensor, Messages]:
        return on_ground, messages

    def new_stop(
        self, state: State, on_ground: Tensor, action_valid: Tensor | None
    ) -> Tensor | None:
        return action_valid


@MOTION_MODELS.register("polynomial")
class PolynomialFlight(MotionModel):
    """Takeoff, cruise and landing take time (paper, eq. 1); the UAV then senses before it chooses
    again."""

    instant = False

    def ready(self, state: State) -> Tensor:
        return state.elapsed >= self.steps(state, self.motion.sensing_time)

    def on_ground(self, state: State) -> Tensor:
        return state.elapsed >= self.steps(state)

    def take_off(self, state: State, goal: Tensor, ready: Tensor, departs: Tensor) -> State:
        origin = torch.where(ready, state.goal, state.origin)
        state = state._replace(origin=origin, goal=goal)
        air = self._air(state)
        cruise = self.shortest_time(air, state.drawn)
        vertical = self.vertical(state) * departs
        return state._replace(
            elapsed=torch.where(ready, 0, state.elapsed),
            vertical=torch.where(ready, vertical, state.vertical),
            cruise=torch.where(ready, cruise, state.cruise),
            cruise_before=torch.where(ready, 0.0, state.cruise_before),
            air=torch.where(ready, air, state.air),
            battery_before=torch.where(ready, state.battery, state.battery_before),
        )

    def resumed(self, state: State, since: Tensor) -> State:
        """Gusts are drawn anew, and batteries are those of the messages up to rounding."""
        sent = state.sent
        flies = sent.in_flight
        stop = sent.trail[..., 0]
        stop_before = sent.trail[..., min(1, sent.trail.shape[-1] - 1)]
        origin = torch.where(flies, stop, stop_before)
        goal = sent.bound_for(self.airspace.points, state.region)
        at_reset = state.elapsed
        ready = torch.ones_like(flies)
        state = self.take_off(state._replace(goal=origin), goal, ready, goal != origin)
        landed = sent.landed[..., 0]
        landing = torch.where(landed > 0, self.steps(state).clamp(min=1), at_reset)
        stood = ((sent.time - landed) / self.dt).round().long()
        elapsed = torch.where(flies, 1, landing + stood)
        battery_before = state.battery
        if self.battery.enabled:
            level = self.move(state._replace(elapsed=elapsed - 1)).battery
            battery_before = battery_before + (sent.battery - level)
        earlier = elapsed + since - 1  # the last of these steps is moved
        return self.move(state._replace(elapsed=earlier, battery_before=battery_before))

    def approach(self, state: State, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """UAVs turn once in a flight, above where they would land, or where they would hold."""
        begin = state.elapsed.double() * self.dt
        descent = state.vertical + state.cruise
        descends = (begin < descent) & (descent <= begin + self.dt) & (state.cruise_before == 0)
        holds = chosen & (state.goal == state.origin)
        arrived = state._replace(battery=self._after_cruise(state))
        return state.goal, torch.where(descends | holds, self.battery_reach(arrived), -1.0)

    def divert(self, state: State, goal: Tensor, turns: Tensor) -> State:
        after = self.take_off(state, goal, turns, turns)
        battery = torch.where(turns, self._after_cruise(state), state.battery_before)
        cruise_before = torch.where(turns, state.cruise, state.cruise_before)
        return after._replace(
            elapsed=state.elapsed, cruise_before=cruise_before, battery_before=battery
        )

    def _after_cruise(self, state: State) -> Tensor:
        """Battery levels [%] after the cruises alone, [B, N]."""
        if not self.battery.enabled:
            return state.battery_before
        return state.battery_before - cruise_drain(state.air, battery_of(self.values, state.drawn))

    def move(self, state: State) -> State:
        state = state._replace(elapsed=state.elapsed + 1)
        elapsed = state.elapsed.double() * self.dt - state.cruise_before
        vertical = state.vertical
        cruise = state.cruise
        way = self.airspace.way(state.origin, state.goal)
        position, crossed = poses(way, self.levels, elapsed, vertical, cruise, self.motion.degree)
        state = state._replace(position=position)
        if not self.battery.enabled:
            return state
        # From the latest decision on, not from step to step, because rounding errors would add up.
        cruised = crossed * state.air
        battery = battery_of(self.values, state.drawn)
        used = used_so_far(elapsed, vertical, cruise, cruised, battery)
        drain = used.to(cruised.dtype)
        rested = state.elapsed - self.steps(state)
        rested = rested.clamp(min=0)
        level = self.battery_after(state, state.battery_before, drain, rested, state.goal)
        return state._replace(battery=level)

    def distance(self, state: State, origin: Tensor, goal: Tensor) -> Tensor:
        if not self.is_windy:
            return self.airspace.length(origin, goal)
        ones = [1] * (origin.dim() - 1)
        wind = self._wind(state).view(-1, *ones, 2)
        air, slowest = self._through(state, origin, goal, wind)
        length = air.where(slowest >= self.motion.min_ground_speed, torch.inf)
        return torch.where(origin == goal, 0.0, length)

    def _air(self, state: State) -> Tensor:
        """Way of each flight through the air that begins now [m], gusts included, [B, N]."""
        if not self.is_windy:
            return self.airspace.length(state.origin, state.goal)
        size, turn = draw(state, _GUST, self.gusts).unbind(-1)
        # Normal east and north (Box and Muller, 1958).
        standard = (-2 * (1 - size).log()).sqrt()
        size = times(standard, self.values.get("wind.gusts", state.drawn))
        gust = displacement(size, 2 * math.pi * turn)
        wind = self._wind(state).unsqueeze(-2) + gust
        air, _ = self._through(state, state.origin, state.goal, wind)
        return air

    def _wind(self, state: State) -> Tensor:
        """Mean wind of each world, the way in which it blows, east and north [m/s], [B, 2]."""
        calm = state.track.new_zeros(len(state.seed), 1)
        speed = calm - self.values.get("wind.speed", state.drawn)
        direction = calm + self.values.get("wind.direction", state.drawn)
        return displacement(speed, direction.deg2rad()).squeeze(-2)

    def _through(
        self, state: State, origin: Tensor, goal: Tensor, wind: Tensor
    ) -> tuple[Tensor, Tensor]:
        """As ``air_length``, of flights between landing points, flat ids [B, N, ...], wind
        [B, 1, ..., 2]."""
        track = state.track
        speed = torch.as_tensor(self.values.get("motion.max_speed", state.drawn))
        speed = speed.to(track).expand_as(track)
        ones = [1] * (origin.dim() - 2)
        speed = speed.view(*track.shape, *ones)
        way = self.airspace.way(origin, goal)
        return air_length(way, wind, speed, self.motion.min_ground_speed)

    def latest_messages(
        self, state: State, on_ground: Tensor, messages: Messages
    ) -> tuple[Tensor, Messages]:
        """A UAV sends messages while it is on the ground, and one from its takeoff point as it
        departs."""
        sends = on_ground | (state.elapsed == 1)
        start = gather_rows(self.points, state.origin)
        position = where_rows(on_ground, messages.position, start)
        sent = messages._replace(position=position)
        return sends, tree_where(sends, sent, state.sent)

    def new_stop(
        self, state: State, on_ground: Tensor, action_valid: Tensor | None
    ) -> Tensor | None:
        """Each decision adds one landing point, however long the UAV then senses there."""
        return on_ground & (state.elapsed == self.steps(state).clamp(min=1))

    def steps(self, state: State, sensing_time: float = 0.0) -> Tensor:
        """Least number of steps after which the latest flight, and a time [s] after it, are over,
        [B, N]."""
        flight = 2 * state.vertical + state.cruise + state.cruise_before
        seconds = flight.double() * (1 - _FLIGHT_ERROR) + sensing_time
        steps_per_second = (1 - _ROUNDING) / self.dt
        return (seconds * steps_per_second).ceil().long()


def check_levels(levels: list[float], airspace: Airspace) -> None:
    """Require that each flight level lies within those of every region."""
    key = "motion.min_level + i * motion.level_separation"
    for region in airspace.regions:
        if region.levels is None:
            continue
        lowest, highest = (FLIGHT_LEVEL_M * level for level in region.levels)
        for level in levels:
            checks.in_range(key, level, lowest, highest, "m")


def _charging_points(config: WorldConfig, airspace: Airspace) -> Tensor:
    """Whether UAVs charge at each landing point, [R*L] bool."""
    places = config.battery.charging_points
    n_regions, n_points = airspace.points.shape[:2]
    if places is None:
        return torch.ones(n_regions * n_points, dtype=torch.bool)
    charges = torch.zeros(n_regions, n_points, dtype=torch.bool)
    for index, region in enumerate(airspace.regions):
        local = local_places("battery.charging_points", places, region)
        charges[index, airspace.nearest(local, index)] = True
    return charges.flatten()
