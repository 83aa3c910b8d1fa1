"""Keys that do not fit the environment, wrong settings and wrong uses are refused in one line."""

import pytest
import torch
from environments import LATE, OBSERVATION, Drift, uavs
from tensordict import TensorDict
from torchrl.envs import Compose, GymEnv, StepCounter, TransformedEnv

from damian import ActionDelay, ActionHistory, Channel, ObservationDelay, RewardDelay, SampleAndHold
from damian.common.errors import InputError

MISSING = {
    "observatoin": lambda: ObservationDelay(3, ["observation", "observatoin"]),
    "act": lambda: SampleAndHold(2, ["observation"], ["act"]),
}


@pytest.mark.parametrize("key", MISSING)
def test_a_key_that_the_environment_does_not_have_is_named(key):
    with pytest.raises(
        InputError, match=f": {key} is not among the keys of the environment: "
    ) as error:
        TransformedEnv(GymEnv("Pendulum-v1"), MISSING[key]()).rollout(3)
    assert "\n" not in str(error.value)


IN_USE = {
    "two ages": lambda: [ObservationDelay(1, OBSERVATION), ObservationDelay(3, OBSERVATION)],
    "an entry of the environment": lambda: [ObservationDelay(2, OBSERVATION, age_key="reward")],
}


@pytest.mark.parametrize("transforms", IN_USE.values(), ids=IN_USE)
def test_an_entry_that_there_is_already_is_not_replaced(transforms):
    with pytest.raises(
        InputError, match="is already an entry of the environment: choose another name"
    ):
        TransformedEnv(uavs(), Compose(*transforms())).rollout(3)


MISTAKES = {
    "in_keys: .* is empty, and so is in_keys_inv": lambda: SampleAndHold(2, [], []),
    "loss: .* is not N x N, 2 x 2: a list": lambda: Channel([[0, 1], [1, 0]], loss=[[0.5] * 3] * 3),
    "comm_range: 5 needs a position_key": lambda: Channel(1, comm_range=5),
}


@pytest.mark.parametrize("line", MISTAKES)
def test_a_wrong_argument_is_one_line(line):
    with pytest.raises(InputError, match=line):
        MISTAKES[line]()


@pytest.mark.parametrize("use", [lambda t: t, Compose])
def test_outside_an_environment_the_error_says_what_to_do(use):
    with pytest.raises(
        RuntimeError, match=r"ObservationDelay.*TransformedEnv\(env.*late_replay_buffer"
    ):
        use(ObservationDelay(2))(TensorDict({"observation": torch.zeros(3, 1)}, [3]))


# Orders in which one transform would undo or miss the work of another.


def delay():
    return ObservationDelay(LATE)


def appending():
    return ActionHistory(2, append_to="observation")


WRONG = {
    "a history before an action delay": (lambda: ActionHistory(2), lambda: ActionDelay(LATE)),
    "an observation delay after a history that appends": (appending, delay),
    "a time limit after a reward delay": (lambda: RewardDelay(2), lambda: StepCounter(max_steps=5)),
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
