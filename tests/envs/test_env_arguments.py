"""Wrong arguments of ``make_env``, of ``UavEnv`` and of what they return are refused in one line."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers import square

from damian import keys
from damian.common.errors import InputError
from damian.delays.config import DelayConfig, LinkConfig
from damian.envs.clocks import ClockConfig
from damian.envs.pipeline import make_env
from damian.envs.scenario import ScenarioConfig
from damian.envs.uav_env import UavEnv
from damian.server.features import ObservationConfig
from damian.server.termination import EpisodeConfig
from damian.world.battery import BatteryConfig
from damian.world.landing import ActionConfig
from damian.world.motion import MotionConfig
from damian.world.regions.config import RegionConfig
from damian.world.signal_source import SourceConfig

EXTRAS = "message, state, reward_terms, position, privileged"
NO_SEED = "is not a whole number such as 0"

WRONG = {
    f"extras: mesage is not one of {EXTRAS}": {"extras": ["mesage"]},
    "extras: 'message' is not a list of names such as ['message']": {"extras": "message"},
    "extras: None is not a list of names such as ['message']": {"extras": None},
    "seed: -3 is not at least 0": {"seed": -3},
    f"seed: 'a' {NO_SEED}": {"seed": "a"},
    f"seed: 1.5 {NO_SEED}": {"seed": 1.5},
    "device: foo is not one of the devices here: cpu": {"device": "foo"},
    "device: cuda is not one of the devices here: cpu": {"device": "cuda"},
    "device: cuda:1 is not one of the devices here: cpu": {"device": torch.device("cuda:1")},
}


@pytest.mark.parametrize("line", WRONG)
@pytest.mark.parametrize("make", [make_env, UavEnv])
def test_a_wrong_argument_is_one_line(line, make, monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    with pytest.raises(InputError) as error:
        make(square(delay=DelayConfig(obs=2)), 2, **WRONG[line])
    assert str(error.value) == line


def test_extras_may_be_any_collection_and_a_seed_one_of_numpy():
    scenario = square(delay=DelayConfig(obs={"law": "uniform", "high": 3}))
    envs = [make_env(scenario, 2, 3, extras=extras) for extras in (["message"], ("message",), {"message"})]
    envs.append(make_env(scenario, 2, np.int64(3), torch.device("cpu"), frozenset({"message"})))  # type: ignore[arg-type]
    steps = [env.rollout(5, policy=_hold, break_when_any_done=False) for env in envs]
    assert all(keys.DELAY in one.keys(True, True) for one in steps)
    assert all((one == steps[0]).all() for one in steps)


def _hold(td):
    return td.set(keys.ACTION, torch.zeros(td["agents"].shape, dtype=torch.long))


def test_links_that_depend_on_the_receiver_need_no_extra_of_that_name():
    law = {"law": "distance", "range": 50.0}
    env = make_env(square(links=LinkConfig("matrix", delay=law)), 2)
    assert env.uav_env.extras == {"message", "position"}


TYPES: dict[str, Callable[[], Any]] = {
    "region.pool: 1.5 is not a whole number": lambda: RegionConfig(pool=1.5),  # type: ignore[arg-type]
    "episode.max_steps: 2.5 is not a whole number": lambda: EpisodeConfig(2.5),  # type: ignore[arg-type]
    "observation.window: True is not a whole number": lambda: ObservationConfig(window=True),
    "battery.enabled: false is not true or false": lambda: BatteryConfig("false"),  # type: ignore[arg-type]
    "motion.kind: None is not one of instant, polynomial": lambda: MotionConfig(None),  # type: ignore[arg-type]
    "actions.distances: 100.0 is not a list": lambda: ActionConfig(distances=100.0),  # type: ignore[arg-type]
    "sensors: 3 is not a list": lambda: ScenarioConfig(sensors=3),  # type: ignore[arg-type]
    "delay: 3 is not a DelayConfig": lambda: ScenarioConfig(delay=3),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("line", TYPES)
def test_a_setting_of_another_type_is_one_line(line):
    with pytest.raises(InputError) as error:
        TYPES[line]()
    assert str(error.value) == line


def test_settings_may_be_numbers_and_arrays_of_numpy_and_torch():
    corners = np.array([[0, 0], [200, 0], [200, 200], [0, 200]])
    starts = [np.array([50.0, 50.0]), torch.tensor([150.0, 50.0])]
    region = RegionConfig("vertices", vertices=corners, start_positions=starts)  # type: ignore[arg-type]
    actions = ActionConfig(distances=np.linspace(0, 100, 3, dtype=np.float32))  # type: ignore[arg-type]
    made = ScenarioConfig(
        agents=np.int64(2),  # type: ignore[arg-type]
        region=region,
        actions=actions,
        source=SourceConfig(position=np.array([60.0, 60.0])),
        clock=ClockConfig(0.5),  # type: ignore[arg-type]
    )
    places = [[50.0, 50.0], [150.0, 50.0]]
    assert made == ScenarioConfig(
        agents=2,
        region=RegionConfig("vertices", vertices=corners.tolist(), start_positions=places),
        actions=ActionConfig(distances=[0.0, 50.0, 100.0]),
        source=SourceConfig(position=[60.0, 60.0]),
        clock=ClockConfig("0.5"),
    )
    assert make_env(made, 2).rollout(2).shape == (2, 2)


@pytest.mark.parametrize("make", [make_env, UavEnv])
def test_floats_of_64_bits_are_refused_before_anything_is_drawn(make):
    torch.set_default_dtype(torch.float64)
    try:
        with pytest.raises(
            InputError, match=r"float64 is not torch\.float32, in which the worlds compute: call"
        ):
            make(square())
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("agents", [2.0, "2", True])
def test_a_number_of_uavs_that_is_not_whole_is_refused(agents):
    with pytest.raises(InputError, match=f"agents: {agents} is not a whole number"):
        ScenarioConfig(agents=agents)


WORLDS = 4
SEEDS = {
    "a tensor of torch.int64, [3]": torch.arange(3),
    "a tensor of torch.int64, [4, 1]": torch.arange(4).view(4, 1),
    "a tensor of torch.float32, [4]": torch.ones(4),
    "a tensor of torch.bool, [4]": torch.ones(4, dtype=torch.bool),
    "[1, 2, 3, 4]": [1, 2, 3, 4],
}


@pytest.mark.parametrize("found", SEEDS)
@pytest.mark.parametrize("obs", [0, 2])
def test_there_is_one_seed_for_each_world(found, obs):
    env = make_env(square(delay=DelayConfig(obs=obs)), WORLDS)
    for one in (env, env.uav_env):
        with pytest.raises(InputError) as error:
            one.seed_worlds(SEEDS[found])
        line = f"seeds: {found} is not a tensor of integers of shape [4], one for each world"
        assert str(error.value) == line
    env.seed_worlds(torch.arange(WORLDS, dtype=torch.int32))
    small = env.reset()
    env.seed_worlds(torch.arange(WORLDS))
    assert (env.reset() == small).all()
