"""Sensors that a user adds: functions of the true state of the worlds, whose readings the messages
carry."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from damian.common import checks
from damian.common.registry import Registry, check_parameters, name_of
from damian.world.config import FOOTPRINT
from damian.world.messages import Messages
from damian.world.state import State


class Sensor(NamedTuple):
    """A function that reads the true state of the worlds, and how many values it returns for a
    UAV."""

    compute: Callable[..., Tensor]
    """From the ``State`` of B worlds and the ``Simulation`` to values, [B, N] or [B, N, width]."""
    width: int
    """Number of values for each UAV."""
    name: str
    """Name of the reading: ``name`` in the settings, or else the function's name."""

    def read(self, state: State, world: Any) -> Tensor:
        """The values as columns, [B, N, width] float32."""
        values = self.compute(state, world)
        shape = (*state.track.shape, self.width)
        same = values.shape == shape or (self.width == 1 and values.shape == shape[:-1])
        checks.require(
            same,
            f"sensor {self.name}: shape",
            [*values.shape],
            f"is not {[*shape]}, of its worlds, UAVs and width: return or declare another one",
        )
        return values.float().view(shape)


def sensor(width: int = 1) -> Callable[[Callable[..., Tensor]], Sensor]:
    """Decorator that makes a sensor of a function.

    The function gets the ``State`` of B worlds when the UAVs and the source have moved, and the
    ``Simulation``; ``state.steps * world.dt`` is the time [s]. It returns a value for each UAV,
    [B, N], or ``width`` of them, [B, N, width]. Its keyword-only arguments are parameters that a
    configuration may set. It must be pure, batched over B and, for ``env.compile()``, free of
    branches on data. Random numbers come from ``damian.common.counter_rng`` with ``state.seed``,
    ``state.episode`` and ``state.steps``.

    Features read the reading, as float32, as ``cache.reading("name")``, by the name of the
    function.

    Examples:
        >>> # in lab.py, used as sensors=[{sensor: lab:loudness, reach: 50}]
        >>> @sensor()
        ... def loudness(state, world, *, reach=100.0):
        ...     to_source = state.position[..., :2] - state.source[:, :1]  # the first one
        ...     return (-torch.linalg.vector_norm(to_source, dim=-1) / reach).exp()
    """
    checks.whole("width of a sensor", width, 1)
    return lambda compute: Sensor(compute, width, compute.__name__)


SENSORS = Registry[Sensor](
    "sensor", Sensor, "is not a sensor: decorate the function with damian.sensor"
)
"""Sensors, as ``package.module:name``."""


@SENSORS.register(FOOTPRINT)
@sensor()
def footprint(state: State, world: Any) -> Tensor:
    """Radius of the UAV's footprint [m], [B, N, 1]."""
    return torch.zeros_like(state.track).unsqueeze(-1) + world.radii(state, world.radius)


def sensors_of(written: Sequence[Any]) -> dict[str, Sensor]:
    """Read ``package.module:name`` or ``{sensor: package.module:name, strength: 3}``; sensors by
    name."""
    found = {}
    for number, each in enumerate(written):
        key = f"sensors[{number}]"
        entry = each if isinstance(each, Mapping) else {"sensor": each}
        path, declared, parameters = SENSORS.read(entry, key, "sensor")
        name = name_of(parameters, declared.name, key)
        check_parameters(declared.compute, parameters, path, key)
        taken = name in found or name in Messages._fields
        problem = (
            "is the name of another sensor, or of a field of the messages: give it another one, as "
            "in "
        )
        checks.require(not taken, f"{key}.name", name, f"{problem}{{sensor: {path}, name: other}}")
        found[name] = Sensor(
            functools.partial(declared.compute, **parameters), declared.width, name
        )
    return found
