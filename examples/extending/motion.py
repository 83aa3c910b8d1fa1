"""Your own motion model: flights against the wind take longer.

    cd examples/extending
    damian train motion=polynomial motion.kind=motion:WindyFlight "motion.options={wind: 4}"

A model derives from ``MotionModel``, or from one that exists. Its methods are pure functions of the
worlds' ``State``.
"""

import math

import torch
from torch import Tensor

from damian.common import checks
from damian.common.tensors import gather_rows
from damian.world.airspace import Airspace
from damian.world.config import WorldConfig
from damian.world.state import State
from damian.world.vehicles import PolynomialFlight


class WindyFlight(PolynomialFlight):
    """Polynomial flights whose level phase is flown at the largest speed minus the head wind."""

    def __init__(self, config: WorldConfig, airspace: Airspace, dt: float) -> None:
        super().__init__(config, airspace, dt)
        options = config.motion.options or {}
        for name in options:
            checks.one_of("motion.options", name, ["wind", "bearing"])
        speed = options.get("wind", 3.0)
        bearing = math.radians(options.get("bearing", 270.0))
        checks.in_range("motion.options.wind", speed, 0.0, 0.9 * config.motion.max_speed, "m/s")
        # The wind blows from its bearing, clockwise from north.
        self.wind = -speed * torch.tensor([math.sin(bearing), math.cos(bearing)])

    def take_off(self, state: State, goal: Tensor, ready: Tensor, departs: Tensor) -> State:
        after = super().take_off(state, goal, ready, departs)
        offset = gather_rows(self.points, after.goal) - gather_rows(self.points, after.origin)
        length = torch.linalg.vector_norm(offset, dim=-1)
        tail_wind = (offset * self.wind).sum(-1) / length.clamp(min=1e-6)
        factor = self.motion.max_speed / (self.motion.max_speed + tail_wind)
        return after._replace(cruise=torch.where(ready, after.cruise * factor, after.cruise))
