"""Features of the UAV itself: where it is, which one, its battery, and how old its message is."""

import torch
from torch import Tensor
from torch.nn import functional as F

from damian.server.config import ObservationConfig
from damian.server.features.base import FeatureCache, feature
from damian.server.features.others import OTHERS, known_ages
from damian.world.battery import BatteryConfig, observed
from damian.world.simulation import Simulation


def kinds_of_uavs(simulation: Simulation, _: ObservationConfig) -> Tensor:
    """Speed limit and battery capacity of each UAV, over the largest ones, [N, 2]."""
    settings = simulation.vehicles.values.settings
    each = []
    for name in ("motion.max_speed", "battery.capacity_kwh"):
        value = torch.as_tensor(settings[name])
        each.append(value.float().expand(simulation.config.agents))
    kinds = torch.stack(each, -1)
    return kinds / kinds.amax(0)


def battery_settings(simulation: Simulation, _: ObservationConfig) -> BatteryConfig:
    """The settings of the battery, which give the resolution of its observed level."""
    return simulation.config.battery


@feature("local", [2], low=-1.0, name="place", entries=["east", "north"])
def _place(v: FeatureCache) -> Tensor:
    """Where the UAV stands or will land, east and north, over half the largest vertex distance,
    [*, N, 2]."""
    return v.scaled(v.messages.target).clamp(-1, 1)


@feature("local", [OTHERS + 1], name="number")
def _number(v: FeatureCache) -> Tensor:
    """Which UAV it is: 1 in one of five columns, in the first one for the first and the sixth,
    [*, N, 5].

    UAVs that share a network and decide at once share out the ground only if something tells them
    apart.
    """
    known = v.messages.time
    n_columns = OTHERS + 1
    number = torch.arange(known.shape[-1], device=known.device)
    marked = F.one_hot(number % n_columns, n_columns).float()
    return marked.expand(*known.shape, n_columns)


@feature("local", [2], name="kind", entries=["speed", "capacity"], tables=[kinds_of_uavs])
def _kind(v: FeatureCache) -> Tensor:
    """Largest speed and battery capacity of the UAV, over the largest of all UAVs, [*, N, 2]."""
    return v.table(kinds_of_uavs).expand(*v.messages.time.shape, 2)


@feature("local", name="battery", tables=[battery_settings])
def _battery(v: FeatureCache) -> Tensor:
    """Level of the battery, as a share, [*, N]."""
    level = observed(v.messages.battery, v.table(battery_settings))
    return level / 100


@feature("actor", name="age")
def _age(v: FeatureCache) -> Tensor:
    """Age of the UAV's message on the server, over ten seconds, [*, N]."""
    return known_ages(v).clamp(max=1)
