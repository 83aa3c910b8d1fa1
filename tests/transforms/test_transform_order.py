"""Orders of transforms in which one would undo or miss the work of another are refused."""

import pytest
from contract import LATE, OBSERVATION, REWARD, Drift, unserved
from plain_env import Plain
from torchrl.envs import (
    Compose,
    ConditionalSkip,
    NoopResetEnv,
    SerialEnv,
    StepCounter,
    TerminateTransform,
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
    SampleAndHold,
)
from damian.transforms.server_node import ServerNode


def delay() -> Transform:
    return ObservationDelay(LATE)


def appending() -> Transform:
    return ActionHistory(2, append_to="observation")


WRONG = {
    "a history before an action delay": (lambda: ActionHistory(2), lambda: ActionDelay(LATE)),
    "a history before a clock": (
        lambda: ActionHistory(2),
        lambda: SampleAndHold(2, [], ["action"]),
    ),
    "an observation delay after a history that appends": (appending, delay),
    "a clock after a history that appends": (appending, lambda: SampleAndHold(2)),
    "a time limit after a reward delay": (lambda: RewardDelay(2), lambda: StepCounter(max_steps=5)),
    "an end after a reward delay": (
        lambda: RewardDelay(2),
        lambda: TerminateTransform(lambda _: True),
    ),
    "skipped steps before a delay": (lambda: ConditionalSkip(lambda td: td["done"]), delay),
    "idle steps after a delay": (delay, lambda: NoopResetEnv(2)),
}
RIGHT = {
    "a history after an action delay": (lambda: ActionDelay(LATE), lambda: ActionHistory(2)),
    "a history that appends after a delay": (delay, appending),
    "a clock after a history with its own entry": (lambda: ActionHistory(2), lambda: SampleAndHold(2)),
    "sums of delayed rewards": (lambda: RewardDelay(LATE), lambda: CumulativeReward(3)),
    "two delays of one observation": (delay, lambda: ObservationDelay(1, age_key=None)),
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


@pytest.mark.parametrize("other", [lambda: RewardDelay(2, REWARD), lambda: SampleAndHold(2, [OBSERVATION])])
def test_a_server_node_must_come_before_transforms_of_its_outputs(other):
    uplink = ObservationDelay(LATE, ("agents", "message"), ("agents", "received"))
    wrong = Compose(uplink, other(), ServerNode(unserved().server))
    with pytest.raises(InputError, match=r"order of transforms: .* must come after ServerNode"):
        TransformedEnv(unserved(), wrong).reset()


def test_an_end_around_the_workers_loses_the_rewards_of_a_delay_within_them():
    """What docs/transforms.md says, and the remedy that it names."""

    def paid(inner: list[Transform], outer: list[Transform]) -> list[float]:
        workers = SerialEnv(2, lambda: TransformedEnv(Plain(), Compose(*[each.clone() for each in inner])))
        env = TransformedEnv(workers, Compose(*outer))
        steps = env.rollout(8, break_when_any_done=False)  # two episodes of 4 steps, which earn 1, 2, 3 and 4
        return steps["next", "agents", "reward"][0, 0, :, 0, 0].tolist()

    assert paid([RewardDelay(2, REWARD)], [StepCounter(4)]) == [0, 0, 1, 2] * 2
    assert paid([StepCounter(4), RewardDelay(2, REWARD)], []) == [0, 0, 1, 2 + 3 + 4] * 2
