"""Features equal those of plain loops over UAVs, on random messages, and lie within [0, 1]."""

import math

import pytest
import torch
import twin
from helpers import SCALE, TIME_SCALE, messages_of, random_worlds
from hypothesis import given, settings
from hypothesis import strategies as st

from damian.common.errors import InputError
from damian.server.features import GLOBAL, LOCAL, ObservationConfig, feature, observe

NAMES = [name for name in (*LOCAL, *GLOBAL) if name != "coverage"]
seeds = st.integers(0, 2**32 - 1)
fleets = st.integers(1, 6)
shares = st.sampled_from([0.0, 0.3, 0.7, 1.0])


def check_features(worlds, newest=False):
    """Compare every feature with the twin's."""
    messages, server = messages_of(worlds)
    ours = observe(messages, server._replace(newest=newest), NAMES)
    for b, (now, uavs) in enumerate(worlds):
        for name, values in twin.features(uavs, now, SCALE, TIME_SCALE, newest=newest).items():
            difference = ours[name][b].double() - torch.tensor(values, dtype=torch.float64)
            if name in ("source_bearing", "source_drift"):  # 0 and 1 are the same angle.
                difference = difference - difference.round()
            assert difference.abs().le(1e-4).all(), name
            assert ((ours[name] >= 0) & (ours[name] <= 1)).all(), name


@settings(max_examples=settings.default.max_examples // 2)
@given(seed=seeds, n_agents=fleets, heard=shares, spots=shares, newest=st.booleans())
def test_every_feature_equals_that_of_a_plain_loop_and_lies_within_0_and_1(
    seed, n_agents, heard, spots, newest
):
    check_features(random_worlds(seed, n_agents, heard, spots), newest)


def one_world(*places, **changed):
    """One world with UAVs at these places; the first has detected the source, the last has these changes."""
    uavs = [twin.Uav(place) for place in places]
    uavs[0].heard_at, uavs[0].heard_from = 5.0, places[0]
    for name, value in changed.items():
        setattr(uavs[-1], name, value)
    return messages_of([(10.0, uavs)])


@pytest.mark.parametrize(
    ("place", "bearing"),
    [((0.0, -50.0), 0.0), ((-50.0, 0.0), 0.25), ((0.0, 50.0), 0.5), ((50.0, 0.0), 0.75)],
)
def test_bearings_are_measured_clockwise_from_north(place, bearing):
    features = observe(*one_world((0.0, 0.0), place), ["source_bearing"])["source_bearing"]
    assert features[0, 1].item() == pytest.approx(bearing, abs=1e-6)


def test_drift_is_one_half_for_a_uav_that_flies_at_the_source_and_less_if_the_source_is_to_its_left():
    north = observe(*one_world((0.0, 0.0), (0.0, -50.0), track=0.0), ["source_drift"])["source_drift"]
    assert north[0, 1].item() == pytest.approx(0.5)
    east = one_world((0.0, 0.0), (0.0, -50.0), track=math.pi / 2)
    assert observe(*east, ["source_drift"])["source_drift"][0, 1].item() == pytest.approx(0.25)


def test_bearing_and_drift_have_no_rounding_errors_at_the_estimated_position_of_the_source():
    worlds = random_worlds(0, 3, 1.0, 1.0, n_worlds=200)
    for _, uavs in worlds:
        for uav in uavs:
            uav.place = uav.heard_from = uavs[0].place
            uav.track = 0.0
    features = observe(*messages_of(worlds), ["source_bearing", "source_drift"])
    assert (features["source_bearing"] == 0).all()
    assert (features["source_drift"] == 0.5).all()


def test_with_ctde_the_actor_observes_local_features_and_the_critic_all():
    features = {"local_features": ["spotted"], "global_features": ["source_time"]}
    assert ObservationConfig(**features, ctde=True).actor == ["spotted"]
    assert ObservationConfig(**features, ctde=False).actor == ["source_time", "spotted"]
    assert ObservationConfig(**features, ctde=True).critic == ["source_time", "spotted"]


def test_the_actor_observes_the_age_of_the_uavs_message_and_the_critic_does_not():
    messages, server = messages_of(random_worlds(0, 3, 1.0, 0.5))
    delayed = messages._replace(time=server.now.unsqueeze(-1) - torch.tensor([0.0, 4.0, 25.0]))
    age = observe(delayed, server, ["age"])["age"]
    torch.testing.assert_close(age, torch.tensor([0.0, 0.4, 1.0]).expand_as(age), rtol=0, atol=1e-5)
    config = ObservationConfig(["spotted"], ["source_time"], ctde=True, age=True)
    assert config.actor == ["spotted", "age"]
    assert config.critic == ["source_time", "spotted"]
    assert ObservationConfig(["spotted"], ["source_time"], age=True).actor == [*config.critic, "age"]


def test_an_impossible_setting_is_refused_in_one_line():
    with pytest.raises(InputError, match="scope of a feature: locale is not one of local, global"):
        feature("locale")
    with pytest.raises(InputError, match=r"observation.local_features: it leaves the actor blind"):
        ObservationConfig([], ctde=True)
