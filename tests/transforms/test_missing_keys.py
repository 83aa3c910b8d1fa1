"""A transform that names a key that the environment does not have is refused in one line."""

import pytest
import torch
from delay_twin import Counting
from torchrl.data import Categorical, Composite
from torchrl.envs import Compose, GymEnv, Transform, TransformedEnv
from transform_cases import ACTION

from damian.common.errors import InputError
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    ObservationDelay,
    RewardDelay,
    SampleAndHold,
)

OUTPUTS = "observation, done, terminated, truncated"


def rollout(*transforms: Transform) -> None:
    """Fly the pendulum with transforms."""
    TransformedEnv(GymEnv("Pendulum-v1"), Compose(*transforms)).rollout(3)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("transform", "key", "known"),
    [
        (ObservationDelay(3, ["observation", "observatoin"]), "observatoin", OUTPUTS),
        (ObservationDelay(3, [("agents", "observation")]), ("agents", "observation"), OUTPUTS),
        (ObservationDelay(3, sent_key="sent"), "sent", OUTPUTS),
        (ActionHistory(2, append_to="observation", age_key="age"), "age", OUTPUTS),
        (ActionHistory(2, recorded_key="redy"), "redy", OUTPUTS),
        (ActionDelay(2, ("agents", "action")), ("agents", "action"), "action"),
        (RewardDelay(2, "rewrad"), "rewrad", "reward"),
        (SampleAndHold(2, ["observation"], ["act"]), "act", "action"),
    ],
)
def test_a_key_that_the_environment_does_not_have_is_one_line(transform, key, known):
    with pytest.raises(InputError) as error:
        rollout(transform)
    name = type(transform).__name__
    assert str(error.value) == f"{name}: {key} is not among the keys of the environment: {known}"


def test_keys_that_earlier_transforms_write_are_known():
    history = ActionHistory(2, append_to="observation", age_key="age")
    rollout(ActionDelay(1), ObservationDelay(2), RewardDelay(2), SampleAndHold(2, age_key="age"), history)


@pytest.mark.parametrize(
    "make", [lambda: ActionHistory(2, recorded_key="fresh"), lambda: ActionDelay(2, sent_key="fresh")]
)
def test_flags_that_a_later_transform_writes_are_known(make):
    rollout(make(), ObservationDelay(2, fresh_key="fresh"))


@pytest.mark.parametrize(
    "make",
    [
        lambda: ActionHistory(2, ACTION, recorded_key="choose"),
        lambda: ActionDelay(2, ACTION, sent_key="choose"),
    ],
)
def test_a_flag_that_is_a_part_of_the_action_is_known(make):
    env, shape = Counting([3, 5]), torch.Size((2, 2))
    specs = {"action": Categorical(7, shape), "choose": Categorical(2, shape, dtype=torch.bool)}
    env.action_spec = Composite(agents=Composite(specs, shape=shape), shape=(2,))
    TransformedEnv(env, make()).rollout(3)
