"""Settings of scenarios and arguments of ``make_env``: what is taken, and what is refused in one
line."""

import pytest
from helpers import square

from damian import ClockConfig, make_env
from damian.common.errors import InputError
from damian.delays.config import LinkConfig
from damian.server.config import ObservationConfig
from damian.world.config import MotionConfig

OWN = ObservationConfig(own=True)
BELIEF = ObservationConfig(belief=["belief_gain"])
REFUSED = {
    "observation.forward: script needs observation.own=true": lambda: square(
        observation=ObservationConfig(forward="script")
    ),
    "observation.own: True does not go with clock.server": lambda: square(
        observation=OWN, clock=ClockConfig(server="2s")
    ),
    "observation.belief: ['belief_gain'] does not go with links=matrix": lambda: square(
        observation=BELIEF, links=LinkConfig("matrix")
    ),
    "extras: mesage is not one of message, state": lambda: make_env(square(), extras=["mesage"]),
    "motion.max_level: 2 m leaves room for 2 flight levels": lambda: make_env(
        square(motion=MotionConfig("polynomial", min_level=1, max_level=2, level_separation=1))
    ),
}


@pytest.mark.parametrize("line", REFUSED)
def test_a_mistake_is_one_line(line):
    with pytest.raises(InputError) as error:
        REFUSED[line]()
    assert str(error.value).startswith(line)
    assert "\n" not in str(error.value)
