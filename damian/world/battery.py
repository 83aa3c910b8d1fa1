"""Battery model (paper, section 3.2): drain of a flight and gain of charging, in percent of the capacity.

The cruise power is proportional to the speed, so the drain of any part of a cruise is exactly
proportional to its length, whatever the time step and the speed profile.
"""

import torch
from torch import Tensor

from damian.world.config import BatteryConfig

_VERTICAL_FACTOR = 0.9
"""In takeoff and landing, the drain at full engine power is divided by this factor."""


def cruise_drain(distance: Tensor, battery: BatteryConfig) -> Tensor:
    """Battery drain of cruising a distance: [*] metres to [*] percent."""
    return distance * (_full_power_drain(battery) / (3600 * battery.reference_speed))


def cruise_range(level: Tensor, battery: BatteryConfig) -> Tensor:
    """Longest cruise on a battery level, the inverse of ``cruise_drain``: [*] percent to [*] metres."""
    return level * (3600 * battery.reference_speed / _full_power_drain(battery))


def vertical_drain(seconds: Tensor, battery: BatteryConfig) -> Tensor:
    """Battery drain of a takeoff or landing: [*] seconds to [*] percent."""
    return seconds * (_full_power_drain(battery) / (3600 * _VERTICAL_FACTOR))


def flight_drain(vertical: Tensor, distance: Tensor, battery: BatteryConfig) -> Tensor:
    """Battery drain of a takeoff, cruise and landing: [*] seconds (of the takeoff) and metres to percent."""
    return vertical_drain(2 * vertical, battery) + cruise_drain(distance, battery)


def used_so_far(
    elapsed: Tensor, vertical: Tensor, cruise: Tensor, cruised: Tensor, battery: BatteryConfig
) -> Tensor:
    """Battery drain of a flight so far, [*] percent, from times [s] and the way cruised [m]."""
    took_off = torch.minimum(elapsed, vertical)
    landing = torch.minimum((elapsed - vertical - cruise).clamp(min=0), vertical)
    return vertical_drain(took_off + landing, battery) + cruise_drain(cruised, battery)


def charge_gain(seconds: Tensor, battery: BatteryConfig) -> Tensor:
    """Battery level gained by charging: [*] seconds to [*] percent; not clipped at a full battery."""
    return seconds * (100 / (3600 * battery.capacity_kwh / battery.charging_power_kw))


def observed(level: Tensor, battery: BatteryConfig) -> Tensor:
    """Observed battery level: [*] percent, rounded down to a multiple of the resolution."""
    # The small offset keeps a level on its multiple where float error left it just below.
    return (torch.floor(level / battery.resolution + 1e-4) * battery.resolution).clamp(max=100)


def _full_power_drain(battery: BatteryConfig) -> float:
    """Battery drain at full engine power [percent per hour]."""
    return 100 * battery.engine_power_kw / (battery.capacity_kwh * battery.efficiency)
