"""Scenario settings: valid and invalid combinations."""

import itertools
import math
from dataclasses import replace
from typing import get_args, get_type_hints

import numpy as np
import pytest
import torch
from helpers import act, random_actions

from damian.common.errors import InputError
from damian.envs.scenario import ScenarioConfig, make_simulation
from damian.envs.uav_env import UavEnv
from damian.recipes.shared.launch import unknown_keys
from damian.server.features import ObservationConfig
from damian.world.battery import BatteryConfig
from damian.world.motion import MotionConfig
from damian.world.regions.config import RegionConfig


def test_a_scenario_needs_no_hydra_and_no_yaml():
    config = ScenarioConfig(agents=5)
    airspace = config.airspace(np.random.default_rng(0))
    assert airspace.n_points.min() >= 5


@pytest.mark.parametrize(
    ("kept", "remedy"), [(None, r"region.lattice_step \(30 m\)"), (4, r"raise region.n_landing_points \(4\)")]
)
def test_more_uavs_than_landing_points_are_refused(kept, remedy):
    vertices = [[0, 0], [100, 0], [100, 100], [0, 100]]
    region = RegionConfig(kind="vertices", vertices=vertices, n_landing_points=kept)
    config = ScenarioConfig(agents=30, region=region)
    with pytest.raises(InputError, match=f"agents: 30 UAVs need as many landing points, .*{remedy}"):
        config.airspace(np.random.default_rng(0))


def test_flight_levels_must_fit_the_scenario_and_the_airspace():
    with pytest.raises(InputError, match="leaves room for 2 flight levels"):
        ScenarioConfig(motion=MotionConfig("polynomial", min_level=1, max_level=2, level_separation=1))
    fir = RegionConfig(kind="fir", path="damian/data/fir.csv", id="LlanbedrTest")
    high = MotionConfig("polynomial", min_level=1828, max_level=2000)
    with pytest.raises(InputError, match=r"1829.0 m is not between 0 and 1828.8 m"):
        make_simulation(ScenarioConfig(agents=3, region=fir, motion=high), 0)


@pytest.mark.parametrize("battery", [False, True])
def test_any_number_of_uavs_fly_instantly_because_they_never_meet_in_the_air(battery):
    region = RegionConfig(kind="fir", path="damian/data/fir.csv", id="LlanbedrTest")
    motion = MotionConfig(min_level=1828, max_level=1828.5)
    scenario = ScenarioConfig(agents=60, region=region, motion=motion, battery=BatteryConfig(battery))
    env = UavEnv(scenario, num_worlds=2)
    env.reset()
    before = env.state.goal.clone()
    act(env, random_actions(env, torch.Generator().manual_seed(0)))
    assert (env.state.goal != before).any()
    assert env.simulation.vehicles.levels.tolist() == [1828.0, 1828.5] * 30
    with pytest.raises(InputError, match=r"leaves room for 2 flight levels .* 60 UAVs"):
        replace(scenario, motion=replace(motion, kind="polynomial"))


def test_a_pool_draws_that_many_different_regions_and_a_seed_repeats_them():
    config = ScenarioConfig(region=RegionConfig(pool=5))
    one, two = (config.airspace(np.random.default_rng(3)) for _ in range(2))
    assert len(one.regions) == 5
    assert len({region.polygon.wkt for region in one.regions}) == 5
    assert [r.polygon.wkt for r in one.regions] == [r.polygon.wkt for r in two.regions]


def test_unknown_keys_are_found_at_any_depth():
    written = {"agents": 3, "motion": {"kind": "instant", "wings": 2}, "delay": {"obs": 3, "foo": 1}}
    assert sorted(unknown_keys(written, ScenarioConfig())) == ["delay.foo", "motion.wings"]


@pytest.mark.parametrize("section", ["", "motion", "source", "battery", "reward", "episode", "observation"])
def test_every_number_of_the_settings_must_be_finite(section):
    config = getattr(ScenarioConfig(), section) if section else ScenarioConfig()
    hints = {name: {hint, *get_args(hint)} for name, hint in get_type_hints(type(config)).items()}
    numbers = [name for name, types in hints.items() if types & {float, int}]
    assert numbers
    for name, value in itertools.product(numbers, [math.nan, math.inf, -math.inf]):
        with pytest.raises(InputError, match=rf"^{section or name}.*: -?(nan|inf) "):
            replace(config, **{name: value})


@pytest.mark.parametrize("age", [False, True])
def test_a_single_uav_must_observe_more_than_its_distances_to_others(age):
    observation = ObservationConfig(local_features=[], global_features=["agent_distances"], age=age)
    with pytest.raises(InputError, match="agent_distances is empty for a single UAV"):
        ScenarioConfig(agents=1, observation=observation)
    assert ScenarioConfig(agents=2, observation=observation).observation.critic == ["agent_distances"]
