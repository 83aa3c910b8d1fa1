"""A wrong argument of a transform is one line that names it, its value and what would be right."""

import numpy as np
import pytest
from plain_env import Plain
from torchrl.data import Unbounded
from torchrl.envs import Compose, GymEnv, TransformedEnv
from transform_cases import ACTION, OBSERVATION

from damian.common.errors import InputError
from damian.delays.laws import Lag, Uniform
from damian.transforms import (
    ActionDelay,
    Channel,
    CumulativeReward,
    MessageHistory,
    ObservationDelay,
    RewardDelay,
    SampleAndHold,
)

NO_KEY = "is not a key such as 'observation' or ('agents', 'observation'), nor a list of keys"
NO_SEED = "is not a whole number such as 0"

WRONG = {
    "out_keys: ['a'] are not 2 keys, as many as what is sent": lambda: ObservationDelay(
        1, ["camera", "gps"], ["a"]
    ),
    "out_keys: ['a', 'b'] are not 1 keys, as many as what is sent": lambda: ObservationDelay(
        1, "camera", ["a", "b"]
    ),
    "in_keys: [] name nothing to send": lambda: ObservationDelay(1, []),
    "in_keys: [] is empty, and so is in_keys_inv: name the entries or the actions to hold": lambda: (
        SampleAndHold(2, [], [])
    ),
    f"keys: 3 {NO_KEY}": lambda: ObservationDelay(1, 3),  # type: ignore[arg-type]
    f"keys: None {NO_KEY}": lambda: RewardDelay(1, [None]),  # type: ignore[arg-type,list-item]
    f"keys: ('agents', 3) {NO_KEY}": lambda: MessageHistory(1, [("agents", 3)]),  # type: ignore[arg-type,list-item]
    "dt: 0.0 s is not above 0 s": lambda: ObservationDelay("3s", dt=0.0),
    "dt: -1 s is not above 0 s": lambda: SampleAndHold("3s", dt=-1),
    "dt: 1s s is not above 0 s": lambda: ActionDelay("3s", dt="1s"),  # type: ignore[arg-type]
    "dt: None s is not above 0 s": lambda: RewardDelay(Lag(1, "2s"), dt=None),  # type: ignore[arg-type]
    "dt: True s is not above 0 s": lambda: Channel("3s", dt=True),
    f"ObservationDelay: seed: 'a' {NO_SEED}": lambda: ObservationDelay(1, seed="a"),  # type: ignore[arg-type]
    f"RewardDelay: seed: 1.5 {NO_SEED}": lambda: RewardDelay(1, seed=1.5),  # type: ignore[arg-type]
    f"Channel: seed: True {NO_SEED}": lambda: Channel(1, seed=True),
    "delay: 3.0 is neither whole steps such as 3 nor a time such as 3s or 0.5m": lambda: ObservationDelay(
        np.float64(3)
    ),
}


@pytest.mark.parametrize("line", WRONG)
def test_a_wrong_argument_is_one_line(line):
    with pytest.raises(InputError) as error:
        WRONG[line]()
    assert str(error.value) == line


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


LEVELS = {
    "an agent's and a world's entry": lambda: ObservationDelay(2, [OBSERVATION, "state"]),
    "a world's and an agent's entry": lambda: ObservationDelay(2, ["state", OBSERVATION]),
    "entries of a clock": lambda: SampleAndHold(2, [OBSERVATION, "state"]),
    "a world's entry and an agent's action": lambda: SampleAndHold(2, ["state"], [ACTION]),
    "an agent's entry and a world's action": lambda: SampleAndHold(2, [OBSERVATION], ["order"]),
    "actions": lambda: SampleAndHold(2, [], [ACTION, "order"]),
}


@pytest.mark.parametrize("make", LEVELS.values(), ids=LEVELS)
def test_entries_of_agents_and_of_worlds_in_one_transform_are_refused_in_one_line(make):
    transform = make()
    one, other = [*transform.in_keys, *transform.in_keys_inv]
    sizes = "[3, 2] and [3]" if isinstance(one, tuple) else "[3] and [3, 2]"
    line = f"{type(transform).__name__}: {one} and {other} have the batch sizes {sizes}: "
    with pytest.raises(InputError) as error:
        TransformedEnv(TwoLevels(), transform).reset()
    assert str(error.value) == line + "use one transform for each level"


def test_one_transform_for_each_level_works():
    delays = ObservationDelay(2, OBSERVATION), ObservationDelay(2, "state")
    clocks = SampleAndHold(2, [OBSERVATION], [ACTION], age_key="age"), SampleAndHold(2, [], ["order"])
    steps = TransformedEnv(TwoLevels(), Compose(*delays, *clocks)).rollout(4)
    assert (steps["agents", "age"].shape, steps["age"].shape) == ((3, 4, 2, 1), (3, 4, 1))
