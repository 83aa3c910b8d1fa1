"""Flights: takeoff, cruise and landing as rest-to-rest polynomials, and the shortest times of each.

A flight starts and ends at rest on a landing point: takeoff to the flight level, cruise at that
level, landing (paper, eq. 1). Each phase follows a polynomial time law of degree 3, 5 or 7.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from damian.common import checks

_TINY = 1e-9

# Largest first and second derivative of each time law over tau in [0, 1].
_PEAK_SPEED = {3: 3 / 2, 5: 15 / 8, 7: 35 / 16}
_PEAK_ACCELERATION = {3: 6.0, 5: 10 * math.sqrt(3) / 3, 7: 84 * math.sqrt(5) / 25}


@dataclass
class MotionConfig:
    """How UAVs move."""

    kind: str = "instant"
    """``instant``: a UAV is at its target when the step ends; ``polynomial``: flights take several steps;
    ``package.module:Class``: your own ``MotionModel``."""
    degree: int = 5
    """Degree of the time law of each phase: 3, 5 or 7."""
    max_speed: float = 5.0
    """Speed limit of a phase [m/s]."""
    max_acceleration: float = 2.0
    """Acceleration limit of a phase [m/s^2]."""
    sensing_time: float = 0.0
    """Time that a landed UAV senses before it may choose again [s]."""
    min_level: float = 1.0
    """Flight level of the first UAV [m]."""
    max_level: float = 20.0
    """Highest flight level [m]. UAVs that fly instantly share levels if there are too few for all of them."""
    level_separation: float = 0.5
    """Vertical distance between the flight levels of two UAVs [m]."""

    options: Any = None
    """Settings of your own motion model, as a mapping."""

    def __post_init__(self) -> None:
        checks.convert_types("motion", self)
        if ":" not in str(self.kind):  # ``damian.world.vehicles`` imports it
            checks.one_of("motion.kind", self.kind, ["instant", "polynomial"])
            problem = f"mean nothing with motion.kind={self.kind}"
            checks.require(self.options is None, "motion.options", self.options, problem)
        checks.one_of("motion.degree", self.degree, [3, 5, 7])
        checks.in_range("motion.max_speed", self.max_speed, 1e-3, unit="m/s")
        checks.in_range("motion.max_acceleration", self.max_acceleration, 1e-3, unit="m/s^2")
        checks.in_range("motion.sensing_time", self.sensing_time, 0.0, unit="s")
        checks.above("motion.min_level", self.min_level, 0.0, "m")
        checks.in_range("motion.max_level", self.max_level, self.min_level, unit="m")
        checks.above("motion.level_separation", self.level_separation, 0.0, "m")


class Pose(NamedTuple):
    """State of a flight: position [*, 3] m, and distance cruised so far [*] m."""

    position: Tensor
    cruised: Tensor


def flight_levels(config: MotionConfig, n_agents: int, shared: bool = False) -> list[float]:
    """One flight level per UAV [m], from the lowest upward.

    Args:
        config: settings of the levels.
        n_agents: number of UAVs.
        shared: where the levels are too few, begin with the lowest one again, as for UAVs that never meet in
            the air.

    Raises:
        InputError: the levels do not fit under the highest one, and are not shared.
    """
    room = (config.max_level - config.min_level) / config.level_separation
    n_fit = math.floor(room + _TINY) + 1
    checks.require(
        shared or n_agents <= n_fit,
        "motion.max_level",
        f"{config.max_level:g} m",
        f"leaves room for {n_fit} flight levels from min_level={config.min_level:g} m, "
        f"level_separation={config.level_separation:g} m apart, but there are {n_agents} UAVs",
    )
    return [config.min_level + i % n_fit * config.level_separation for i in range(n_agents)]


def time_law(tau: Tensor, degree: int) -> Tensor:
    """Share of a phase's length covered at the share ``tau`` of its time (paper, eq. 1).

    The polynomial of lowest degree with s(0) = 0, s(1) = 1 and 1, 2 or 3 vanishing derivatives at
    both ends. ``tau`` is clamped to [0, 1].

    Args:
        tau: share of the time, any shape.
        degree: 3, 5 or 7.
    """
    t = tau.clamp(0.0, 1.0)
    if degree == 3:
        return t.square() * (3 - 2 * t)
    if degree == 5:
        return t.pow(3) * ((6 * t - 15) * t + 10)
    return t.pow(4) * (((70 - 20 * t) * t - 84) * t + 35)


def minimum_time(length: Tensor, degree: int, max_speed: float, max_acceleration: float) -> Tensor:
    """Shortest time of a rest-to-rest phase within both limits; 0 for length 0.

    Closed form: the time law's largest derivatives are constants, so each limit gives one time.

    Args:
        length: [*] metres.
        degree: 3, 5 or 7.
        max_speed: limit of the speed [m/s].
        max_acceleration: limit of the acceleration [m/s^2].

    Returns:
        Seconds, [*].
    """
    for_speed = length * (_PEAK_SPEED[degree] / max_speed)
    for_acceleration = (length * (_PEAK_ACCELERATION[degree] / max_acceleration)).sqrt()
    return torch.maximum(for_speed, for_acceleration)


def fly(
    origin: Tensor,
    target: Tensor,
    level: Tensor,
    elapsed: Tensor,
    vertical: Tensor,
    cruise: Tensor,
    degree: int,
) -> Pose:
    """Poses of UAVs some time after takeoff; from the end of their flights on, they stand at the targets.

    Args:
        origin: takeoff points, [*, 2] metres.
        target: landing points, [*, 2] metres.
        level: flight levels above 0, [*] metres.
        elapsed: time since takeoff, [*] seconds; long flights need double precision.
        vertical: duration of takeoff, and of landing, above 0, [*] seconds.
        cruise: duration of the cruise, [*] seconds; 0 if origin and target are the same.
        degree: degree of the time law, 3, 5 or 7.
    """
    # A landing is a takeoff reversed in time, s(1 - tau) = 1 - s(tau), so one evaluation serves both.
    remaining = torch.add(cruise, vertical, alpha=2) - elapsed
    climbing = torch.minimum(elapsed, remaining) / vertical
    cruising = (elapsed - vertical) / cruise.clamp_min(_TINY)
    shares = torch.stack([climbing, cruising]).to(origin.dtype)
    climbed, crossed = time_law(shares, degree).unbind(0)
    place = torch.lerp(origin, target, crossed.unsqueeze(-1))
    position = torch.cat([place, (level * climbed).unsqueeze(-1)], dim=-1)
    return Pose(position, crossed * torch.linalg.vector_norm(target - origin, dim=-1))
