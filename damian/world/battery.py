"""Battery model (paper, section 3.2): drain of a flight and gain of charging, in percent of the
capacity.

The cruise power is proportional to the speed, so the drain of any part of a cruise is exactly
proportional to its length, whatever the time step and the speed profile.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from damian.world.config import BatteryConfig
from damian.world.values import Value, Values, times

_VERTICAL_FACTOR = 0.9
"""In takeoff and landing, the drain at full engine power is divided by this factor."""


class Battery(NamedTuple):
    """The settings of batteries as numbers, of all UAVs or of each, or of each world."""

    engine_power_kw: Value
    reference_speed: Value
    capacity_kwh: Value
    efficiency: Value
    charging_power_kw: Value


AnyBattery = BatteryConfig | Battery


def battery_of(values: Values, drawn: Tensor) -> Battery:
    """The batteries in worlds whose drawn values are ``drawn`` [B, D]."""
    return Battery._make(values.get(f"battery.{name}", drawn) for name in Battery._fields)


def cruise_drain(distance: Tensor, battery: AnyBattery) -> Tensor:
    """Battery drain of cruising a distance: [*] metres to [*] percent."""
    return times(distance, _full_power_drain(battery) / (3600 * battery.reference_speed))


def cruise_range(level: Tensor, battery: AnyBattery) -> Tensor:
    """Longest cruise on a battery level, the inverse of ``cruise_drain``: [*] percent to [*]
    metres."""
    return times(level, 3600 * battery.reference_speed / _full_power_drain(battery))


def vertical_drain(seconds: Tensor, battery: AnyBattery) -> Tensor:
    """Battery drain of a takeoff or landing: [*] seconds to [*] percent."""
    return times(seconds, _full_power_drain(battery) / (3600 * _VERTICAL_FACTOR))


def flight_drain(vertical: Tensor, distance: Tensor, battery: AnyBattery) -> Tensor:
    """Battery drain of a takeoff, cruise and landing: [*] seconds (of the takeoff) and metres to
    percent."""
    return vertical_drain(2 * vertical, battery) + cruise_drain(distance, battery)


def used_so_far(
    elapsed: Tensor, vertical: Tensor, cruise: Tensor, cruised: Tensor, battery: AnyBattery
) -> Tensor:
    """Battery drain of a flight so far, [*] percent, from times [s] and the way cruised [m]."""
    took_off = torch.minimum(elapsed, vertical)
    landing = torch.minimum((elapsed - vertical - cruise).clamp(min=0), vertical)
    return vertical_drain(took_off + landing, battery) + cruise_drain(cruised, battery)


def charge_gain(seconds: Tensor, battery: AnyBattery) -> Tensor:
    """Battery level gained by charging: [*] seconds to [*] percent; not clipped at a full
    battery."""
    return times(seconds, 100 / (3600 * battery.capacity_kwh / battery.charging_power_kw))


def observed(level: Tensor, battery: BatteryConfig) -> Tensor:
    """Observed battery level: [*] percent, rounded down to a multiple of the resolution."""
    # The small offset keeps a level on its multiple where float error left it just below.
    return (torch.floor(level / battery.resolution + 1e-4) * battery.resolution).clamp(max=100)


def _full_power_drain(battery: AnyBattery) -> Value:
    """Battery drain at full engine power [percent per hour]."""
    return 100 * battery.engine_power_kw / (battery.capacity_kwh * battery.efficiency)
