"""Flights (paper, eq. 1): takeoff to the flight level, cruise and landing as rest-to-rest
polynomials."""

import math

import torch
from torch import Tensor

from damian.common import checks
from damian.world.config import MotionConfig
from damian.world.values import Value, times

_TINY = 1e-9
# Largest first and second derivative of each time law over tau in [0, 1].
_PEAK_SPEED = {3: 3 / 2, 5: 15 / 8, 7: 35 / 16}
_PEAK_ACCELERATION = {3: 6.0, 5: 10 * math.sqrt(3) / 3, 7: 84 * math.sqrt(5) / 25}


def flight_levels(config: MotionConfig, n_agents: int, shared: bool = False) -> list[float]:
    """One flight level per UAV [m], from the lowest upward; if ``shared``, UAVs may have the same
    one."""
    lowest = config.min_level
    apart = config.level_separation
    room = (config.max_level - lowest) / apart
    n_fit = math.floor(room + _TINY) + 1
    checks.require(
        shared or n_agents <= n_fit,
        "motion.max_level",
        f"{config.max_level:g} m",
        f"leaves room for {n_fit} flight levels from min_level={lowest:g} m, "
        f"level_separation={apart:g} m apart, but there are {n_agents} UAVs",
    )
    return [lowest + i % n_fit * apart for i in range(n_agents)]


def time_law(tau: Tensor, degree: int) -> Tensor:
    """Share of a phase's length covered at the share ``tau`` of its time, any shape (paper, eq. 1).

    The polynomial of lowest degree (3, 5 or 7) with s(0) = 0, s(1) = 1 and 1, 2 or 3 vanishing
    derivatives at both ends. ``tau`` is clamped to [0, 1].
    """
    t = tau.clamp(0.0, 1.0)
    if degree == 3:
        return t.square() * (3 - 2 * t)
    if degree == 5:
        rest = (6 * t - 15) * t + 10
        return t.pow(3) * rest
    rest = ((70 - 20 * t) * t - 84) * t + 35
    return t.pow(4) * rest


def minimum_time(length: Tensor, degree: int, max_speed: Value, max_acceleration: Value) -> Tensor:
    """Shortest time [s] of a rest-to-rest phase [m] within limits of speed and acceleration, [*].

    Closed form: the time law's largest derivatives are constants, so each limit gives one time.
    """
    for_speed = times(length, _PEAK_SPEED[degree] / max_speed)
    for_acceleration = times(length, _PEAK_ACCELERATION[degree] / max_acceleration).sqrt()
    return torch.maximum(for_speed, for_acceleration)


def place_on(way: Tensor, share: Tensor) -> Tensor:
    """Places [*, 2] m after a share [*] of the ways over places [*, W, 2] m."""
    if way.shape[-2] == 2:
        return torch.lerp(way[..., 0, :], way[..., 1, :], share.unsqueeze(-1))
    legs, length = _legs(way)
    flown = share * length.sum(-1)
    begins = length.cumsum(-1) - length
    since = flown.unsqueeze(-1) - begins  # since each leg began [m]
    done = (since / length.clamp_min(_TINY)).clamp(0, 1)
    done = done * (length > 0)
    displaced = (done.unsqueeze(-1) * legs).sum(-2)
    place = way[..., 0, :] + displaced
    flies = share.unsqueeze(-1) < 1
    return torch.where(flies, place, way[..., -1, :])  # there, to the bit


def _legs(way: Tensor) -> tuple[Tensor, Tensor]:
    """Legs of ways [*, W, 2] m, [*, W - 1, 2], and their lengths, [*, W - 1]."""
    legs = way.diff(dim=-2)
    return legs, torch.linalg.vector_norm(legs, dim=-1)


def air_length(way: Tensor, wind: Tensor, airspeed: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Way through the air [*] m of flights over places [*, W, 2] m, and their lowest ground speeds
    [*] m/s.

    A leg of length L, flown at the ``airspeed`` v [*] m/s, has the ground speed sqrt(v^2 - cross^2)
    + along, by the wind across and along it; its way through the air is L v over that. ``wind``
    [*, 2] m/s: the way in which it blows, east and north; ground speeds below ``least`` count as
    this.
    """
    legs, length = _legs(way)
    scaled = (legs * wind.unsqueeze(-2)).sum(-1)
    along = scaled / length.clamp_min(_TINY)
    wind_squared = wind.square().sum(-1, keepdim=True)
    cross_squared = (wind_squared - along.square()).clamp_min(0)
    speed = airspeed.unsqueeze(-1)
    heading_speed = (speed.square() - cross_squared).clamp_min(0).sqrt()
    ground = heading_speed + along
    slowest = torch.where(length > 0, ground, torch.inf).amin(-1)
    air = length * speed / ground.clamp_min(least)
    return air.sum(-1), slowest


def poses(
    way: Tensor, level: Tensor, elapsed: Tensor, vertical: Tensor, cruise: Tensor, degree: int
) -> tuple[Tensor, Tensor]:
    """Positions [*, 3] m of UAVs ``elapsed`` seconds after takeoff, and how much of the cruise is
    flown [*].

    After their flights, they stand at the targets.

    ``way``: places from the origin to the target, [*, W, 2] m, ``level`` above 0 [*] m, and
    durations [s] of takeoff or landing, above 0, and of the cruise, 0 for no flight; ``elapsed`` in
    double precision. The second result is a share, from 0 to 1.
    """
    # A landing is a takeoff reversed in time, s(1 - tau) = 1 - s(tau), so one evaluation serves
    # both.
    remaining = torch.add(cruise, vertical, alpha=2) - elapsed
    climbing = torch.minimum(elapsed, remaining) / vertical
    cruising = (elapsed - vertical) / cruise.clamp_min(_TINY)
    shares = torch.stack([climbing, cruising]).to(way.dtype)
    climbed, crossed = time_law(shares, degree).unbind(0)
    place = place_on(way, crossed)
    height = (level * climbed).unsqueeze(-1)
    return torch.cat([place, height], dim=-1), crossed
