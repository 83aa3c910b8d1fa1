"""Features equal those of plain loops over UAVs, on random messages, and lie within [0, 1]."""

import re

import torch
import twin
from helpers import SCALE, TIME_SCALE, messages_of, random_worlds
from hypothesis import given, settings, strategies as st

from damian.common.fields import rules
from damian.server.config import ObservationConfig
from damian.server.features import FEATURES, observe

NAMES = [name for name in (*twin.LOCAL, *twin.GLOBAL) if name != "coverage"]
shares = st.sampled_from([0.0, 0.3, 0.7, 1.0])


@settings(max_examples=settings.default.max_examples // 2)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_agents=st.integers(1, 6),
    heard=shares,
    spots=shares,
)
def test_every_feature_equals_that_of_a_plain_loop_and_lies_within_0_and_1(
    seed, n_agents, heard, spots
):
    worlds = random_worlds(seed, n_agents, heard, spots)
    messages, server = messages_of(worlds)
    ours = observe(messages, server, NAMES)
    for b, (now, uavs) in enumerate(worlds):
        for name, values in twin.features(uavs, now, SCALE, TIME_SCALE).items():
            difference = ours[name][b].double() - torch.tensor(values, dtype=torch.float64)
            if name in ("source_bearing", "source_drift"):  # 0 and 1 are the same angle.
                difference = difference - difference.round()
            assert difference.abs().le(1e-4).all(), name
            assert ((ours[name] >= 0) & (ours[name] <= 1)).all(), name


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
    torch.testing.assert_close(
        age,
        torch.tensor([0.0, 0.4, 1.0]).expand_as(age),
        rtol=0,
        atol=1e-5,
    )
    config = ObservationConfig(["spotted"], ["source_time"], ctde=True, age=True)
    assert config.actor == ["spotted", "age"]
    assert config.critic == ["source_time", "spotted"]
    assert ObservationConfig(["spotted"], ["source_time"], age=True).actor == [
        *config.critic,
        "age",
    ]


def test_the_help_names_every_feature():
    said = rules(ObservationConfig)
    for key, scope in (
        ("local_features", "local"),
        ("global_features", "global"),
        ("belief", "belief"),
    ):
        known = {name for name in FEATURES if FEATURES.get(name, key).scope == scope}
        assert known <= {*re.findall(r"\w+", said[key].meaning)}, key
