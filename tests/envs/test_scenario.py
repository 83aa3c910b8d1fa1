"""Scenario settings: valid and invalid combinations."""

import numpy as np
import pytest

from damian.common.errors import InputError
from damian.envs.scenario import ScenarioConfig
from damian.recipes.shared.launch import unknown_keys
from damian.world.motion import MotionConfig
from damian.world.regions.config import RegionConfig


def test_a_scenario_needs_no_hydra_and_no_yaml():
    config = ScenarioConfig(agents=5)
    airspace = config.airspace(np.random.default_rng(0))
    assert airspace.n_points.min() >= 5


def test_more_uavs_than_landing_points_are_refused():
    region = RegionConfig(kind="vertices", vertices=[[0, 0], [100, 0], [100, 100], [0, 100]])
    config = ScenarioConfig(agents=30, region=region)
    with pytest.raises(InputError, match="agents: 30 UAVs need as many landing points"):
        config.airspace(np.random.default_rng(0))


def test_flight_levels_must_fit_the_scenario_and_the_airspace():
    with pytest.raises(InputError, match="leaves room for 2 flight levels"):
        ScenarioConfig(motion=MotionConfig(min_level=1, max_level=2, level_separation=1))
    fir = RegionConfig(kind="fir", path="damian/data/fir.csv", id="LlanbedrTest")
    high = MotionConfig(min_level=1828, max_level=2000)
    with pytest.raises(InputError, match=r"1829.0 m is not between 0 and 1828.8 m"):
        ScenarioConfig(agents=3, region=fir, motion=high).airspace(np.random.default_rng(0))


def test_a_pool_draws_that_many_different_regions_and_a_seed_repeats_them():
    config = ScenarioConfig(region=RegionConfig(pool=5))
    one, two = (config.airspace(np.random.default_rng(3)) for _ in range(2))
    assert len(one.regions) == 5
    assert len({region.polygon.wkt for region in one.regions}) == 5
    assert [r.polygon.wkt for r in one.regions] == [r.polygon.wkt for r in two.regions]


def test_unknown_keys_are_found_at_any_depth():
    written = {"agents": 3, "motion": {"kind": "instant", "wings": 2}, "delay": {"obs": 3, "foo": 1}}
    assert sorted(unknown_keys(written, ScenarioConfig())) == ["delay.foo", "motion.wings"]
