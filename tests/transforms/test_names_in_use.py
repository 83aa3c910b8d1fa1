"""A transform that would write over an entry that there is already is refused in one line."""

import pytest
from plain_env import GROUP, Plain
from torchrl.data import Composite, Unbounded
from torchrl.envs import Compose, GymEnv, SerialEnv, Transform, TransformedEnv

from damian.common.errors import InputError
from damian.transforms import ActionHistory, MessageHistory, ObservationDelay, RewardDelay
from damian.transforms.reward import EpisodeTotals

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


@pytest.mark.parametrize(
    "transforms",
    [
        lambda: [ObservationDelay(1, CAMERA), ObservationDelay(3, GPS)],
        lambda: [ObservationDelay(1, CAMERA, "seen"), ObservationDelay(3, GPS, "seen", age_key=None)],
        lambda: [RewardDelay(1, REWARD, delay_key="late"), RewardDelay(2, REWARD, delay_key="late")],
        lambda: [ActionHistory(2, ACTION), ActionHistory(3, ACTION)],
        lambda: [MessageHistory(2, CAMERA), MessageHistory(2, GPS)],
        lambda: [EpisodeTotals(REWARD), EpisodeTotals(REWARD)],
        lambda: [ObservationDelay(2, CAMERA, age_key="gps")],
        lambda: [ObservationDelay(2, CAMERA, age_key=("done",))],
        lambda: [RewardDelay(1, REWARD, earned_key="reward")],
    ],
)
def test_an_entry_that_there_is_already_is_not_replaced(transforms):
    assert IN_USE in refused(Sensors(), *transforms())


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
