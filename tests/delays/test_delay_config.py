"""What the settings of delays say of themselves."""

import pytest

from damian.delays.config import DelayConfig


@pytest.mark.parametrize(
    ("settings", "dt", "named"),
    [
        ({"obs": 50}, 1.0, ["delay.obs"]),
        ({"obs": 49, "act": "100s"}, 2.0, ["delay.act"]),
        ({"rew": 60, "loss": 0.5}, 1.0, ["delay.rew"]),
        ({"obs": {"law": "uniform", "low": 0, "high": 90}}, 1.0, []),
        ({}, 1.0, []),
    ],
)
def test_delays_are_named_in_which_nothing_arrives_before_an_episode_ends(settings, dt, named):
    assert DelayConfig(**settings).settings_longer_than(50, dt) == named
