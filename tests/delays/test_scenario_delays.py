"""What an environment has been made from may change: it keeps its own copy, and the next one
follows."""

import json
from copy import deepcopy
from dataclasses import replace

import pytest
from delay_twin import trace
from delayed_envs import choices
from helpers import all_same, play, ring, square

from damian import TableSampler, UavEnv, make_env
from damian.delays.config import DelayConfig, LinkConfig
from damian.learners.config import MappoConfig
from damian.recipes.config import TrainConfig
from damian.recipes.shared.learning import learning_env, make_learner, replay_buffer
from damian.recipes.shared.settings import check_learning
from damian.world.config import RegionConfig, SourceConfig


def test_an_environment_reads_a_trace_once(tmp_path):
    delay = DelayConfig(
        obs=trace(tmp_path, 1, 2, 0),
        act="0..2",
        rew=1,
        history=2,
    )
    scenario = square(delay=delay, links=LinkConfig("matrix", delay=1))
    config = TrainConfig(
        **vars(scenario),
        learner=MappoConfig(steps=5),
        worlds=2,
        backupdate=True,
    )
    check_learning(config)
    env = learning_env(config)
    next(tmp_path.iterdir()).unlink()  # so that to read it again fails
    make_learner(config, env, replay_buffer(config, env))
    env.rollout(3)


def write_trace(path, delay):
    path.write_text("delay\n" + f"{delay}\n" * 20)


def write_region(path, side):
    degrees = side * 1e-5
    places = ring(0.0, 0.0, degrees, degrees)
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [places]}))


FILES = {
    "trace": (write_trace, (1, 5), lambda env: env.delays.longest),
    "region": (
        write_region,
        (150, 300),
        lambda env: env.uav_env.simulation.airspace.scale.item() // 1.57,
    ),
}
"""What writes a file, from which numbers, and the number that an environment has read; a diagonal
of 1e-5 degrees is 1.57 metres long."""


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("copied", [lambda s: s, deepcopy, replace])
def test_a_file_that_was_rewritten_is_read_anew(tmp_path, kind, copied):
    (write, numbers, read), path = FILES[kind], tmp_path / "file.csv"
    told = {"delay": DelayConfig(obs={"law": "trace", "path": str(path)})}
    if kind == "region":
        path = path.with_suffix(".geojson")
        told = {"region": RegionConfig("geojson", path=str(path), lattice_step=40.0)}
        told["source"] = SourceConfig()
    scenario = square(**told)
    for number in numbers:
        write(path, number)
        assert read(make_env(copied(scenario))) == number


CHANGES = {
    "delay": lambda scenario: setattr(scenario.delay, "obs", TableSampler([[0.0] * 3 + [1.0]])),
    "limit": lambda scenario: setattr(scenario.episode, "max_steps", 2),
    "lists": lambda scenario: scenario.observation.local_features.pop(),
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("make", [make_env, UavEnv])
def test_an_environment_keeps_the_settings_with_which_it_was_made(make, change):
    scenario = square(delay=DelayConfig(obs=TableSampler([[0.0, 1.0]])))
    changed = make(scenario, 2, 1)
    untouched = make(deepcopy(scenario), 2, 1)
    CHANGES[change](scenario)
    actions = choices(untouched, 8)
    assert all_same(play(changed, actions), play(untouched, actions))
    same = play(make(scenario, 2, 1), actions)  # the next environment follows
    assert make is UavEnv or not all_same(same, play(untouched, actions))


def test_a_learner_keeps_the_settings_with_which_it_was_made():
    config = TrainConfig(
        **vars(square()),
        learner=MappoConfig(steps=5),
        worlds=2,
    )
    env = learning_env(config)
    learner = make_learner(config, env, None)
    config.learner.epochs = 40
    config.model.hidden = []
    assert (learner.config.epochs, learner.setup.model.hidden) == (4, [256, 256])
