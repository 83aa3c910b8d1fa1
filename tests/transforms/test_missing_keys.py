"""A transform that names a key that the environment does not have is refused in one line."""

import pytest
from torchrl.envs import Compose, GymEnv, Transform, TransformedEnv

from damian.common.errors import InputError
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    CumulativeReward,
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
        (ObservationDelay(3, ["observatoin"]), "observatoin", OUTPUTS),
        (ObservationDelay(3, ["observation", "observatoin"]), "observatoin", OUTPUTS),
        (ObservationDelay(3, ["observatoin"], ["late"], age_key=None), "observatoin", OUTPUTS),
        (ObservationDelay(3, [("agents", "observation")]), ("agents", "observation"), OUTPUTS),
        (ObservationDelay(3, sent_key="sent"), "sent", OUTPUTS),
        (ActionHistory(2, append_to="observatoin"), "observatoin", OUTPUTS),
        (ActionHistory(2, append_to="observation", age_key="age"), "age", OUTPUTS),
        (ActionHistory(2, "act"), "act", "action"),
        (ActionDelay(2, ("agents", "action")), ("agents", "action"), "action"),
        (RewardDelay(2, "rewrad"), "rewrad", "reward"),
        (CumulativeReward(2, reward_key="rewrad"), "rewrad", "reward"),
        (SampleAndHold(2, ["observatoin"]), "observatoin", OUTPUTS),
        (SampleAndHold(2, ["observation"], ["act"]), "act", "action"),
        (SampleAndHold(2, ["observation"], ready_key="ready"), "ready", OUTPUTS),
    ],
)
def test_a_key_that_the_environment_does_not_have_is_one_line(transform, key, known):
    with pytest.raises(InputError) as error:
        rollout(transform)
    name = type(transform).__name__
    assert str(error.value) == f"{name}: {key} is not among the keys of the environment: {known}"


def test_keys_that_earlier_transforms_write_are_known():
    history = ActionHistory(2, append_to="observation", age_key="age")
    rollout(ActionDelay(1), ObservationDelay(2), RewardDelay(2), SampleAndHold(2), history)
