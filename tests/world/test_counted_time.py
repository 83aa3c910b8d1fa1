"""Times are counted in steps: decisions and flights, against exact arithmetic."""

import math
from fractions import Fraction

import torch
from helpers import clock, fresh, one_uav
from hypothesis import given, settings, strategies as st

from damian.world.config import MotionConfig


@given(
    period=st.sampled_from(["0.1", "0.3", "0.7", "1", "2.5", "0.025", "60"]),
    vertical=st.floats(0.125, 1024.0, width=32),
    cruise=st.floats(0.0, 2.0**17, width=32),
    tenths=st.integers(0, 10**4),
)
@settings(max_examples=settings.default.max_examples // 5)
def test_a_flight_ends_after_exactly_its_duration_but_for_its_float_error(
    period, vertical, cruise, tenths
):
    motion = MotionConfig("polynomial", sensing_time=tenths / 10)
    env = fresh(one_uav(motion=motion, clock=clock(f"{period}s")))
    flight = {
        "vertical": torch.tensor([[vertical]]),
        "cruise": torch.tensor([[cruise]]),
    }
    duration = 2 * Fraction(vertical) + Fraction(cruise)
    models = env.simulation.vehicles
    for holds, sensing in ((models.on_ground, 0), (models.ready, Fraction(tenths, 10))):
        least, most = (
            math.ceil((duration * (1 - error) + sensing) / Fraction(period))
            for error in (Fraction(2, 10**6), Fraction(0))
        )
        if most - least <= 1:  # so many steps that the float error of the duration is more than one
            steps = range(max(most - 3, 0), most + 4)
            states = [env.state._replace(**flight, elapsed=torch.tensor([[n]])) for n in steps]
            flags = [bool(holds(state)) for state in states]
            assert flags == sorted(flags)
            assert least <= steps[flags.index(True)] <= most
