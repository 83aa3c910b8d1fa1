"""Orders of transforms in which one would undo or miss the work of another are refused."""

import pytest
from contract import LATE, Drift
from torchrl.envs import (
    Compose,
    ConditionalSkip,
    StepCounter,
    Transform,
    TransformedEnv,
)

from damian.common.errors import InputError
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    CumulativeReward,
    ObservationDelay,
    RewardDelay,
)


def delay() -> Transform:
    return ObservationDelay(LATE)


def appending() -> Transform:
    return ActionHistory(2, append_to="observation")


WRONG = {
    "a history before an action delay": (lambda: ActionHistory(2), lambda: ActionDelay(LATE)),
    "an observation delay after a history that appends": (appending, delay),
    "a time limit after a reward delay": (lambda: RewardDelay(2), lambda: StepCounter(max_steps=5)),
    "skipped steps before a delay": (lambda: ConditionalSkip(lambda td: td["done"]), delay),
}
RIGHT = {
    "a history after an action delay": (lambda: ActionDelay(LATE), lambda: ActionHistory(2)),
    "a history that appends after a delay": (delay, appending),
    "sums of delayed rewards": (lambda: RewardDelay(LATE), lambda: CumulativeReward(3)),
}


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("pair", WRONG.values(), ids=WRONG)
def test_a_wrong_order_of_transforms_is_refused(pair, nested):
    one, other = (make() for make in pair)
    if nested:
        env = TransformedEnv(TransformedEnv(Drift(), one), other)
    else:
        env = TransformedEnv(Drift(), Compose(one, other))
    with pytest.raises(InputError, match=r"order of transforms: .* must come after"):
        env.reset()


@pytest.mark.parametrize("pair", RIGHT.values(), ids=RIGHT)
def test_a_right_order_of_transforms_works(pair):
    env = TransformedEnv(Drift(), Compose(*(make() for make in pair)))
    assert env.rollout(6, break_when_any_done=False).shape == (3, 6)
