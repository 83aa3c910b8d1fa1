"""The examples that a person copies run, and learn under delay (slow)."""

import os
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from episodes import flight

EXAMPLES = Path(__file__).parents[1] / "examples"


def load(name: str) -> dict[str, Any]:
    """The names that an example defines."""
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


def test_critics_learn_from_the_states_and_the_actor_from_what_it_knew():
    storage, _ = load("sac_backupdating")["train"](delay=6, frames=150, warm_up=120)
    learnt = storage.steps[storage.latest()[:-6]]
    assert len(learnt) == 150 - 6
    assert learnt["next", "state"].equal(learnt["next", "observation"])
    assert learnt["known"][6:, :, :3].equal(learnt["state"][:-6])  # six steps old, then six actions
    assert learnt["known"][6:, :, -1:].equal((learnt["action"][5:-1] + 2) / 4)


def test_ppo_behind_delays_takes_a_few_steps():
    (mean,) = load("ppo_gymnasium")["train"](delay=2, frames=1000)
    assert 9 < mean < 60


def test_multi_agent_ppo_behind_delays_takes_a_few_steps():
    pytest.importorskip("vmas")
    assert len(load("ppo_vmas")["train"](batches=1)) == 1


@pytest.mark.slow
def test_ppo_behind_delays_learns():
    means = load("ppo_gymnasium")["train"](delay=3, frames=30_000)
    assert sum(means[-10:]) / 10 > 150  # random actions last 22 steps


@pytest.mark.slow
def test_multi_agent_ppo_behind_delays_learns():
    pytest.importorskip("vmas")
    means = load("ppo_vmas")["train"](batches=40)
    assert means[-1] > means[0] + 1


@pytest.mark.slow
def test_soft_actor_critic_with_back_updating_swings_the_pendulum_up():
    _, returns = load("sac_backupdating")["train"](frames=12_000)
    assert sum(returns[-10:]) / 10 > -400  # random actions return -1200


def test_a_recording_for_rerun_has_the_places_and_the_detections_of_every_uav(tmp_path):
    reader, rows = pytest.importorskip("rerun.chunk").RrdReader, {}
    spotted = np.array([[False, False], [True, False], [True, False], [False, False]])
    flown = flight(spotted=spotted, about={"uavs": ["A/1", "B"]})
    load("rerun_episode")["save_recording"](flown, tmp_path / "flown.rrd")
    for chunk in reader(tmp_path / "flown.rrd").stream():
        if not chunk.is_static:
            rows[chunk.entity_path] = chunk.to_record_batch().to_pydict().get("Points3D:positions")
    assert [len(points) for points in rows[r"/detections/A\/1"]] == [0, 1, 1, 0]
    assert rows["/uavs/B"] == [[[100.0, 100.0, 0.0]]] * 4


@pytest.mark.slow
def test_a_search_with_optuna_keeps_its_trials_and_goes_on(tmp_path):
    pytest.importorskip("optuna")
    words = ["frames=64", "worlds=2", "learner.steps=16", "eval_episodes=2", "episode.max_steps=8"]
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for n in ("1", "2"):
        command = [sys.executable, str(EXAMPLES / "tune.py"), n, *words]
        subprocess.run(command, cwd=tmp_path, env=os.environ | {"PATH": path}, check=True)
    assert len([*tmp_path.glob("runs/tune/*/result.csv")]) == 2
