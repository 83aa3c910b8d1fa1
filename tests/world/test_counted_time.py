"""Times are counted in steps: decisions, flights, charging and limits, against exact arithmetic."""

import math
from fractions import Fraction

import torch
from helpers import clock, fresh, one_uav
from hypothesis import given, settings
from hypothesis import strategies as st

from damian.envs.uav_env import UavEnv
from damian.world.motion import MotionConfig
from damian.world.state import State

periods = st.sampled_from(["0.1", "0.3", "0.7", "1", "2.5", "0.025", "60"])


def one_state(env: UavEnv, **changed) -> State:
    """The state of the only UAV of an environment with changed fields."""
    state = env.state
    return state._replace(
        **{name: torch.full_like(getattr(state, name), value) for name, value in changed.items()}
    )


def first_step(env: UavEnv, holds, near: int, **changed) -> int:
    """The first number of steps since the latest decision at which a condition on the state holds."""
    steps = range(max(near - 3, 0), near + 4)
    flags = [bool(holds(one_state(env, elapsed=n, **changed)).item()) for n in steps]
    assert flags == sorted(flags)
    assert True in flags
    return steps[flags.index(True)]


@given(
    period=periods,
    vertical=st.floats(0.125, 1024.0, width=32),
    cruise=st.floats(0.0, 2.0**17, width=32),
    tenths=st.integers(0, 10**4),
)
@settings(max_examples=settings.default.max_examples // 5)
def test_a_flight_ends_after_exactly_its_duration_but_for_its_float_error(period, vertical, cruise, tenths):
    motion = MotionConfig("polynomial", sensing_time=tenths / 10)
    env = fresh(one_uav(motion=motion, clock=clock(f"{period}s")))
    duration = 2 * Fraction(vertical) + Fraction(cruise)
    models = ((env.simulation.vehicles.on_ground, 0), (env.simulation.ready, Fraction(tenths, 10)))
    for holds, sensing in models:
        least, most = (
            math.ceil((duration * (1 - error) + sensing) / Fraction(period))
            for error in (Fraction(2, 10**6), Fraction(0))
        )
        if most - least <= 1:  # so many steps that the float error of the duration is more than one
            assert least <= first_step(env, holds, most, vertical=vertical, cruise=cruise) <= most
