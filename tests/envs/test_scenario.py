"""Settings of scenarios and arguments of ``make_env``: what is taken, and what is refused in one line."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
import torch
from helpers import square

from damian import keys
from damian.common.errors import InputError
from damian.delays.config import DelayConfig, LinkConfig
from damian.envs.pipeline import make_env
from damian.envs.scenario import ScenarioConfig, make_simulation
from damian.envs.uav_env import UavEnv
from damian.server.features import ObservationConfig
from damian.server.termination import EpisodeConfig
from damian.settings import ClockConfig
from damian.world.landing import ActionConfig
from damian.world.motion import MotionConfig
from damian.world.regions.config import RegionConfig
from damian.world.signal_source import SourceConfig

OWN = ObservationConfig(own=True)
BELIEF = ObservationConfig(belief=["belief_gain"])
REFUSED: dict[str, Callable[[], Any]] = {
    "sensors: 3 is not a list": lambda: square(sensors=3),
    "delay: 3 is not a DelayConfig": lambda: square(delay=3),
    "observation.own: True does not go with clock.server": lambda: square(
        observation=OWN, clock=ClockConfig(server="2s")
    ),
    "observation.own: True does not go with links=updown": lambda: square(
        observation=OWN, links=LinkConfig("updown")
    ),
    "observation.belief: ['belief_gain'] does not go with links=matrix": lambda: square(
        observation=BELIEF, links=LinkConfig("matrix")
    ),
    "observation.belief: ['belief_gain'] needs discrete actions": lambda: square(
        observation=BELIEF, actions=ActionConfig("continuous")
    ),
    "delay.messages: 3 does not go with links=updown": lambda: square(
        delay=DelayConfig(messages=3), links=LinkConfig("updown")
    ),
    "observation: agent_distances is empty for a single UAV": lambda: square(
        agents=1, observation=ObservationConfig([], ["agent_distances"])
    ),
    "episode.discharged_share: 0.5 needs battery.enabled=true": lambda: square(
        episode=EpisodeConfig(discharged_share=0.5)
    ),
    "episode.end_with_source: True needs source.motion=dynamic": lambda: square(
        episode=EpisodeConfig(end_with_source=True)
    ),
    "clock.skip: True skips steps": lambda: make_env(
        square(clock=ClockConfig(skip=True)), extras=["message"]
    ),
    "extras: mesage is not one of message, state": lambda: make_env(square(), extras=["mesage"]),
    "seed: -3 is not at least 0": lambda: make_env(square(), seed=-3),
    "device: foo is not one of the devices here: cpu": lambda: UavEnv(square(), device="foo"),
    "num_worlds: 0 is not between 1 and": lambda: UavEnv(square(), 0),
    "seeds: [3] of torch.int64 are not 2 integers": lambda: make_env(square(), 2).seed_worlds(
        torch.arange(3)
    ),
    "motion.max_level: 2 m leaves room for 2 flight levels": lambda: make_env(
        square(motion=MotionConfig("polynomial", min_level=1, max_level=2, level_separation=1))
    ),
}


@pytest.mark.parametrize("line", REFUSED)
def test_a_mistake_is_one_line(line):
    with pytest.raises(InputError) as error:
        REFUSED[line]()
    assert str(error.value).startswith(line)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("kept", "remedy"), [(None, r"region.lattice_step \(30 m\)"), (4, r"raise region.n_landing_points \(4\)")]
)
def test_more_uavs_than_landing_points_are_refused(kept, remedy):
    vertices = [[0, 0], [100, 0], [100, 100], [0, 100]]
    region = RegionConfig(kind="vertices", vertices=vertices, n_landing_points=kept)
    with pytest.raises(InputError, match=f"agents: 30 UAVs need as many landing points, .*{remedy}"):
        make_simulation(ScenarioConfig(agents=30, region=region), 0)


@pytest.mark.parametrize("section", ["", "motion", "source", "battery", "reward", "episode", "observation"])
def test_every_number_of_the_settings_must_be_finite(section):
    config = getattr(ScenarioConfig(), section) if section else ScenarioConfig()
    hints = {name: {hint, *get_args(hint)} for name, hint in get_type_hints(type(config)).items()}
    numbers = [name for name, types in hints.items() if types & {float, int}]
    assert numbers
    for name, value in itertools.product(numbers, [math.nan, math.inf, -math.inf]):
        with pytest.raises(InputError, match=rf"^{section or name}.*: -?(nan|inf) "):
            replace(config, **{name: value})


def test_settings_may_be_numbers_and_arrays_of_numpy_and_torch():
    corners = np.array([[0, 0], [200, 0], [200, 200], [0, 200]])
    starts = [np.array([50.0, 50.0]), torch.tensor([150.0, 50.0])]
    made = ScenarioConfig(
        agents=np.int64(2),  # type: ignore[arg-type]
        region=RegionConfig("vertices", vertices=corners, start_positions=starts),  # type: ignore[arg-type]
        actions=ActionConfig(distances=np.linspace(0, 100, 3, dtype=np.float32)),  # type: ignore[arg-type]
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


def test_extras_may_be_any_collection_and_a_seed_one_of_numpy():
    scenario = square(delay=DelayConfig(obs={"law": "uniform", "high": 3}))
    one = make_env(scenario, 2, 3, extras=["message"]).reset()
    other = make_env(scenario, 2, np.int64(3), torch.device("cpu"), frozenset({"message"})).reset()  # type: ignore[arg-type]
    assert keys.DELAY in one.keys(True, True)
    assert (one == other).all()
