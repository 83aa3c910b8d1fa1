"""A wrong argument of a transform is one line that names it, its value and what would be right."""

import numpy as np
import pytest
from plain_env import Plain
from torchrl.data import Unbounded
from torchrl.envs import Compose, GymEnv, TransformedEnv
from transform_cases import ACTION, OBSERVATION

from damian.common.errors import InputError
from damian.delays.laws import Burst, Uniform
from damian.transforms import (
    CumulativeReward,
    ObservationDelay,
    RewardDelay,
    SampleAndHold,
)

WRONG = {
    "out_keys: .* are not 2 keys": lambda: ObservationDelay(1, ["camera", "gps"], ["a"]),
    "in_keys: .* name nothing to send": lambda: ObservationDelay(1, []),
    "in_keys: .* is empty, and so is in_keys_inv": lambda: SampleAndHold(2, [], []),
    "keys: 3 is not a key such as": lambda: ObservationDelay(1, 3),  # type: ignore[arg-type]
    "keys: .* is not a key such as": lambda: ObservationDelay(1, [("agents", 3)]),  # type: ignore[arg-type,list-item]
    "dt: -1 s is not above 0 s": lambda: SampleAndHold("3s", dt=-1),
    "seed: 'a' is not a whole number": lambda: ObservationDelay(1, seed="a"),  # type: ignore[arg-type]
    "delay: 3.0 is neither whole steps such as 3 nor a time": lambda: ObservationDelay(np.float64(3)),
    "delay: .* loses messages, but no reward": lambda: RewardDelay(Burst(bad_loss=0.5)),
    "steps: 0 is not at least 1": lambda: CumulativeReward(0),
}


@pytest.mark.parametrize("line", WRONG)
def test_a_wrong_argument_is_one_line(line):
    with pytest.raises(InputError, match=line):
        WRONG[line]()


def test_whole_numbers_of_numpy_are_steps_and_seeds():
    def ages(number: type) -> list[float]:
        delays = ObservationDelay(Uniform(number(1), number(4)), seed=number(3))
        rewards = [RewardDelay(number(2)), CumulativeReward(3)]
        clock = SampleAndHold(number(2), age_key="age")
        env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(delays, clock, *rewards))
        return env.rollout(30)["age"].flatten().tolist()

    assert ages(np.int64) == ages(np.int32) == ages(int)
    assert len({*ages(int)}) > 3


def test_every_whole_number_is_a_seed():
    drawn = []
    for seed in (-1, 0, 2**70 + 5):
        env = TransformedEnv(GymEnv("Pendulum-v1"), ObservationDelay(Uniform(1, 9), seed=seed))
        drawn.append(env.rollout(20)["age"].flatten().tolist())
    assert drawn[0] != drawn[1] != drawn[2]


class TwoLevels(Plain):
    """Three worlds of two agents, with an entry and an action of each world beside those of the agents."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_spec["state"] = Unbounded((3, 5))
        self.full_action_spec["order"] = Unbounded((3, 1))


@pytest.mark.parametrize(
    "make",
    [
        lambda: ObservationDelay(2, [OBSERVATION, "state"]),
        lambda: ObservationDelay(2, ["state", OBSERVATION]),
        lambda: SampleAndHold(2, [OBSERVATION, "state"]),
    ],
)
def test_entries_of_agents_and_of_worlds_in_one_transform_are_refused(make):
    with pytest.raises(InputError, match="have other batch sizes: use one transform for each"):
        TransformedEnv(TwoLevels(), make()).reset()


def test_one_transform_for_each_level_works():
    delays = ObservationDelay(2, OBSERVATION), ObservationDelay(2, "state")
    clocks = SampleAndHold(2, [OBSERVATION], [ACTION], age_key="age"), SampleAndHold(2, [], ["order"])
    steps = TransformedEnv(TwoLevels(), Compose(*delays, *clocks)).rollout(4)
    assert (steps["agents", "age"].shape, steps["age"].shape) == ((3, 4, 2, 1), (3, 4, 1))
