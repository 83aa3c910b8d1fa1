"""Features against one loop per UAV, on random snapshots; all of them within [0, 1]."""

import math

import pytest
import torch
import twin
from helpers import SCALE, TIME_SCALE, random_worlds, snapshot_of
from hypothesis import given
from hypothesis import strategies as st

from damian.common.errors import InputError
from damian.server.features import GLOBAL, LOCAL, ObservationConfig, observe, stack
from damian.world.messages import Messages

NAMES = [name for name in (*LOCAL, *GLOBAL) if name != "coverage"]
seeds = st.integers(0, 2**32 - 1)
fleets = st.integers(1, 6)
shares = st.sampled_from([0.0, 0.3, 0.7, 1.0])


def check(worlds, newest=False):
    snapshot, server = snapshot_of(worlds)
    ours = observe(snapshot, server._replace(newest=newest), NAMES)
    for b, (now, uavs) in enumerate(worlds):
        for name, values in twin.features(uavs, now, SCALE, TIME_SCALE, newest=newest).items():
            apart = ours[name][b].double() - torch.tensor(values, dtype=torch.float64)
            if name in ("source_bearing", "source_drift"):  # 0 and 1 are the same angle.
                apart = apart - apart.round()
            assert apart.abs().le(1e-4).all(), name
            assert ((ours[name] >= 0) & (ours[name] <= 1)).all(), name


@given(seed=seeds, n_agents=fleets, heard=shares, spots=shares, newest=st.booleans())
def test_every_feature_equals_its_loop_and_lies_between_0_and_1(seed, n_agents, heard, spots, newest):
    check(random_worlds(seed, n_agents, heard, spots), newest)


@pytest.mark.parametrize("n_agents", [1, 2, 5])
@pytest.mark.parametrize(("heard", "spots"), [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)])
def test_features_hold_when_nobody_or_everybody_hears_or_spots(n_agents, heard, spots):
    check(random_worlds(1, n_agents, heard, spots, n_worlds=20))


def test_before_any_detection_the_source_is_as_far_and_as_long_ago_as_can_be():
    snapshot, server = snapshot_of(random_worlds(0, 3, 0.0, 0.0))
    names = ["source_distance", "source_bearing", "source_drift", "source_time"]
    assert all((value == 1).all() for value in observe(snapshot, server, names).values())


def at(*places, **changed):
    """One world; UAV 0 has heard the source, from its own place, unless told otherwise."""
    uavs = [twin.Uav(place) for place in places]
    uavs[0].heard_at, uavs[0].heard_from = 5.0, places[0]
    for name, value in changed.items():
        setattr(uavs[-1], name, value)
    return snapshot_of([(10.0, uavs)])


@pytest.mark.parametrize(
    ("place", "bearing"),
    [((0.0, -50.0), 0.0), ((-50.0, 0.0), 0.25), ((0.0, 50.0), 0.5), ((50.0, 0.0), 0.75)],
)
def test_bearings_turn_clockwise_from_north(place, bearing):
    seen = observe(*at((0.0, 0.0), place), ["source_bearing"])["source_bearing"]
    assert seen[0, 1].item() == pytest.approx(bearing, abs=1e-6)


def test_a_uav_that_flies_at_the_source_has_drift_one_half_and_to_its_left_less():
    north = observe(*at((0.0, 0.0), (0.0, -50.0), track=0.0), ["source_drift"])["source_drift"]
    assert north[0, 1].item() == pytest.approx(0.5)
    east = at((0.0, 0.0), (0.0, -50.0), track=math.pi / 2)
    assert observe(*east, ["source_drift"])["source_drift"][0, 1].item() == pytest.approx(0.25)


def test_a_uav_that_stands_where_it_believes_the_source_sees_no_rounding_errors():
    worlds = random_worlds(0, 3, 1.0, 1.0, n_worlds=200)
    for _, uavs in worlds:
        for uav in uavs:
            uav.place = uav.heard_from = uavs[0].place
            uav.track = 0.0
    seen = observe(*snapshot_of(worlds), ["source_bearing", "source_drift"])
    assert (seen["source_bearing"] == 0).all()
    assert (seen["source_drift"] == 0.5).all()


def test_the_source_is_believed_in_the_middle_of_the_latest_detections():
    snapshot, server = at((0.0, 0.0), (100.0, 0.0), (50.0, 0.0), heard_at=2.0)
    heard = torch.tensor([[[0.0, 100.0], [0.0, 0.0], [100.0, -100.0]]])
    snapshot = snapshot._replace(detected_position=heard)  # UAV 1 has heard nothing.
    seen = observe(snapshot, server, ["source_distance", "source_time"])
    assert seen["source_distance"][0].tolist() == pytest.approx([0.2, 0.2, 0.0])
    assert seen["source_time"][0].tolist() == pytest.approx([5 / 60] * 3)


def test_every_feature_but_the_distances_to_others_has_one_value_whatever_the_fleet():
    for n_agents in (1, 3, 7):
        seen = observe(*snapshot_of(random_worlds(0, n_agents, 0.5, 0.5)), NAMES)
        for name, value in seen.items():
            wide = (n_agents - 1,) if name == "agent_distances" else ()
            assert value.shape == (4, n_agents, *wide), name


def test_what_nobody_wants_is_not_computed():
    snapshot, server = snapshot_of(random_worlds(0, 3, 0.5, 0.5))
    assert observe(snapshot, server, ["spotted"]).keys() == {"spotted"}
    with pytest.raises(ValueError, match="footprint tables"):
        observe(snapshot, server, ["coverage"])


def test_leading_dimensions_are_free():
    snapshot, server = snapshot_of(random_worlds(0, 3, 0.5, 0.5))
    expected = stack(observe(snapshot, server, NAMES), NAMES)
    deep = Messages(*[field.unflatten(0, (2, 2)) for field in snapshot])
    now, scale = (x.unflatten(0, (2, 2)) for x in (server.now, server.scale))
    seen = stack(observe(deep, server._replace(now=now, scale=scale), NAMES), NAMES)
    assert seen.shape == (2, 2, 3, len(NAMES) + 1)
    assert seen.flatten(0, 1).equal(expected)
    alone = Messages(*[field[1] for field in snapshot])
    one = server._replace(now=server.now[1], scale=server.scale[1])
    torch.testing.assert_close(stack(observe(alone, one, NAMES), NAMES), expected[1])


def test_an_observation_lists_its_features_in_the_written_order():
    snapshot, server = snapshot_of(random_worlds(0, 3, 1.0, 0.5))
    names = ["spotted", "agent_distances", "source_distance"]
    seen = observe(snapshot, server, names)
    vector = stack(seen, names)
    assert vector[..., 0].equal(seen["spotted"])
    assert vector[..., 1:3].equal(seen["agent_distances"])
    assert vector[..., 3].equal(seen["source_distance"])


def test_with_ctde_the_actor_sees_its_local_features_and_the_critic_all():
    shown = {"local_features": ["spotted"], "global_features": ["source_time"]}
    assert ObservationConfig(**shown, ctde=True).actor == ["spotted"]
    assert ObservationConfig(**shown, ctde=False).actor == ["source_time", "spotted"]
    assert ObservationConfig(**shown, ctde=True).critic == ["source_time", "spotted"]


def test_a_uav_sees_the_age_of_its_own_message_and_the_critic_does_not():
    snapshot, server = snapshot_of(random_worlds(0, 3, 1.0, 0.5))
    late = snapshot._replace(time=server.now.unsqueeze(-1) - torch.tensor([0.0, 4.0, 25.0]))
    age = observe(late, server, ["age"])["age"]
    torch.testing.assert_close(age, torch.tensor([0.0, 0.4, 1.0]).expand_as(age), rtol=0, atol=1e-5)
    config = ObservationConfig(["spotted"], ["source_time"], ctde=True, age=True)
    assert config.actor == ["spotted", "age"]
    assert config.critic == ["source_time", "spotted"]
    assert ObservationConfig(["spotted"], ["source_time"], age=True).actor == [*config.critic, "age"]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"local_features": ["source_time"]},
            "observation.local_features: source_time is not one of battery, spotted",
        ),
        ({"time_scale": 0.0}, "observation.time_scale: 0.0 s is not above 0 s"),
        ({"window": 0}, "observation.window: 0 is not between 1 and 16"),
        (
            {"local_features": [], "ctde": True},
            "observation.local_features: [] leaves the actor blind",
        ),
    ],
)
def test_a_wrong_observation_is_named_with_its_value(changed, message):
    with pytest.raises(InputError) as error:
        ObservationConfig(**changed)
    assert str(error.value) == message


def test_an_unknown_feature_is_named_with_those_that_exist():
    with pytest.raises(InputError, match=r"^observation\.global_features: odour is not one of s"):
        ObservationConfig(global_features=["odour"])
