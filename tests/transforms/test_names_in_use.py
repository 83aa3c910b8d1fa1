"""A transform that would write over an entry that there is already is refused in one line."""

import pytest
from plain_env import GROUP, Plain
from torchrl.data import Composite, Unbounded
from torchrl.envs import Compose, GymEnv, SerialEnv, Transform, TransformedEnv

from damian.common.errors import InputError
from damian.transforms import ActionDelay, ActionHistory, MessageHistory, ObservationDelay, RewardDelay
from damian.transforms.episode_totals import EpisodeTotals

CAMERA, GPS = ("agents", "camera"), ("agents", "gps")
ACTION, REWARD = ("agents", "action"), ("agents", "reward")


class Sensors(Plain):
    """Agents with a camera, and a position, four zeros each."""

    def __init__(self, **more: Unbounded) -> None:
        super().__init__()
        four = {name: Unbounded((*GROUP, 4)) for name in ("camera", "gps")}
        self.observation_spec = Composite(
            agents=Composite(**four, **more, shape=GROUP), shape=self.batch_size
        )


def refused(env, *transforms: Transform) -> str:
    with pytest.raises(InputError) as error:
        TransformedEnv(env, Compose(*transforms)).rollout(3)  # type: ignore[arg-type]
    assert "\n" not in str(error.value)
    return str(error.value)


IN_USE = "is already an entry of the environment: choose another name"

TWICE = {
    "age": (lambda: [ObservationDelay(1, CAMERA), ObservationDelay(3, GPS)], "age_key='gps_age'"),
    "fresh": (
        lambda: [
            ObservationDelay(1, CAMERA, age_key=None, fresh_key="fresh"),
            ObservationDelay(3, GPS, age_key=None, fresh_key="fresh"),
        ],
        "fresh_key='gps_fresh'",
    ),
    "delay": (
        lambda: [
            ObservationDelay(1, CAMERA, delay_key="delay"),
            ObservationDelay(3, GPS, age_key=None, delay_key="delay"),
        ],
        "delay_key='gps_delay'",
    ),
    "late": (
        lambda: [RewardDelay(1, REWARD, delay_key="late"), RewardDelay(2, REWARD, delay_key="late")],
        "delay_key='reward_late'",
    ),
    "earned": (
        lambda: [RewardDelay(1, REWARD, earned_key="earned"), RewardDelay(2, REWARD, earned_key="earned")],
        "earned_key='reward_earned'",
    ),
}


@pytest.mark.parametrize("key", TWICE)
def test_two_transforms_that_would_write_one_entry_are_refused_with_the_remedy(key):
    make, remedy = TWICE[key]
    name = type(make()[1]).__name__
    line = f"{name}: ('agents', '{key}') {IN_USE}, such as {remedy}, or None to leave it out"
    assert refused(Sensors(), *make()) == line


@pytest.mark.parametrize(
    "transforms",
    [
        lambda: [ObservationDelay(1, CAMERA, "seen"), ObservationDelay(3, GPS, "seen", age_key=None)],
        lambda: [ActionHistory(2, ACTION), ActionHistory(3, ACTION)],
        lambda: [MessageHistory(2, CAMERA), MessageHistory(2, GPS)],
        lambda: [EpisodeTotals(REWARD), EpisodeTotals(REWARD)],
    ],
    ids=["received entries", "actions", "messages", "totals"],
)
def test_other_entries_of_the_same_name_are_refused(transforms):
    assert refused(Sensors(), *transforms()).endswith(IN_USE)


def test_an_entry_of_the_environment_itself_is_not_replaced():
    own = Sensors(age=Unbounded((*GROUP, 1)))
    assert refused(own, ObservationDelay(2, CAMERA)).endswith(
        f"{IN_USE}, such as age_key='camera_age', or None to leave it out"
    )
    for name in ("reward", "camera"):
        line = refused(Sensors(), ObservationDelay(2, CAMERA, age_key=name))
        assert line.startswith(f"ObservationDelay: ('agents', '{name}') {IN_USE}")
    assert IN_USE in refused(Sensors(), ObservationDelay(2, CAMERA, age_key=("done",)))
    assert IN_USE in refused(Sensors(), RewardDelay(1, REWARD, earned_key="reward"))
    assert IN_USE in refused(GymEnv("Pendulum-v1"), ObservationDelay(2, age_key="done"))


def test_one_transform_gives_each_of_its_entries_its_own_name():
    line = refused(Sensors(), ObservationDelay(2, CAMERA, fresh_key="age"))
    assert line == "ObservationDelay: names of the entries that it writes: ('agents', 'age') appears twice"


def test_a_delay_around_workers_does_not_replace_the_age_of_the_delay_within():
    def make() -> TransformedEnv:
        return TransformedEnv(GymEnv("Pendulum-v1"), ObservationDelay(1))

    assert "ObservationDelay: age is already" in refused(SerialEnv(2, make), ObservationDelay(2))


def test_entries_with_names_of_their_own_have_their_own_ages():
    delays = [ObservationDelay(1, CAMERA, age_key="camera_age"), ObservationDelay(3, GPS)]
    agents = TransformedEnv(Sensors(), Compose(*delays)).rollout(6)["next", "agents"]  # type: ignore[arg-type]
    assert agents["camera_age"][0, :, 0, 0].tolist() == [1, 1, 1, 1, 1, 1]
    assert agents["age"][0, :, 0, 0].tolist() == [1, 2, 3, 3, 3, 3]


def test_two_action_delays_do_not_write_one_flag():
    line = refused(
        Sensors(), ActionDelay(1, ACTION, valid_key="valid"), ActionDelay(2, ACTION, valid_key="valid")
    )
    assert line == (
        "ActionDelay: ('agents', 'valid') is already the flag of another ActionDelay: choose another name"
    )
