"""The examples run from any folder, do what their text says, and learn under delay (slow)."""

import ast
import importlib
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from episodes import flight
from torchrl.envs import Compose, GymEnv, SerialEnv, TransformedEnv

import damian.transforms
from damian import Uniform

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
PROGRAMS = [
    path for folder in ("docs", "examples") for path in sorted((ROOT / folder).rglob("*.py"))
]
ELSEWHERE = {
    "docs/upstream/test_": "is one of TorchRL's own tests",
    "examples/benchmarl/": "needs BenchMARL, which asks for another TorchRL",
    "examples/benchmarks/bench_jaxmarl": "needs JaxMARL, which asks for other versions",
    "examples/fleet/": "is a distribution of its own, with tests of its own",
    "examples/tune": "needs Optuna, which is no extra of tests",
}
"""How the paths of programs begin that are not imported here, and why; what they import of damian
is."""
DOCUMENT = (ROOT / "docs" / "backupdating.md").read_text()


def load(name):
    """The names that an example defines, whose program does not run."""
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


def run(name):
    """The names that an example about transforms defines when its program runs."""
    return runpy.run_path(str(EXAMPLES / "transforms" / f"{name}.py"), run_name="__main__")


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_a_program_is_imported(path):
    if not path.relative_to(ROOT).as_posix().startswith(tuple(ELSEWHERE)):
        runpy.run_path(str(path))
        return
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "damian":
            exec(ast.unparse(node), {})


def test_back_updated_rewards_and_ends_are_the_true_ones_wherever_the_message_has_arrived(capsys):
    example = load("backupdating")
    steps, collected = example["main"]()
    after = steps["next"]
    n_steps = len(steps)
    arrived = torch.arange(n_steps).view(-1, 1, 1) + after["delay"] < n_steps
    assert n_steps - 7 < arrived.sum() / steps.shape[1] < n_steps
    truth = example["judge"](after["message"])
    for name in ("reward", "terminated"):
        assert after[name][arrived].equal(truth[name][arrived])
    assert not collected[arrived].equal(truth["reward"][arrived])
    printed = re.findall(r"mean error of the (.*): (\S+)", capsys.readouterr().out)
    errors = {name: float(value) for name, value in printed}
    assert errors["reward after back-updating"] < 0.05 * errors["reward as collected"]
    assert errors["message in hindsight"] < 0.05 * errors["message that the room held"]


def test_the_smallest_case_of_the_document_prints_what_stands_below_it(capsys):
    code, printed = re.findall(r"```(?:python)?\n(.*?\n)```", DOCUMENT, re.DOTALL)[:2]
    exec(code, {})
    lines = capsys.readouterr().out.splitlines()
    assert [
        line for line in lines if "torchrl" not in line
    ] == printed.splitlines()  # it logs there, too


def test_the_delays_for_torchrl_stand_alone_and_are_ours(tmp_path, monkeypatch):
    for folder in ("torchrl/envs", "test/transforms", "docs/source/reference"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "torchrl/envs/__init__.py").touch()
    reference = tmp_path / "docs/source/reference/envs_transforms.rst"
    reference.write_text("    ActionDiscretizer\n    ObservationNorm\n    ObservationTransform\n")
    runpy.run_path(str(ROOT / "docs" / "upstream" / "to_torchrl.py"))["main"](tmp_path)
    monkeypatch.syspath_prepend(tmp_path / "torchrl" / "envs" / "transforms")
    rollouts = []
    for package, uniform in (
        (importlib.import_module("delays"), (1, 4)),
        (damian.transforms, Uniform(1, 4)),
    ):
        late = package.ObservationDelay(
            uniform, "observation", "received", loss=0.2, delay_key="delay"
        )
        timeline = package.ObservationTimeline(6, delay_key="delay")
        env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(package.ActionDelay(2), late, timeline))
        package.set_seed(env, 0)
        torch.manual_seed(0)
        rollouts.append(env.rollout(30))
    assert [*reference.read_text().split()][::2] == [
        "ActionDelay",
        "ObservationDelay",
        "ObservationTimeline",
    ]
    assert (rollouts[0] == rollouts[1]).all()
    assert rollouts[0]["delay"].unique().tolist() == [-1, 0, 1, 2, 3, 4]


def test_a_late_pendulum_prints_the_age_of_what_it_observes(capsys):
    age = run("late_pendulum")["steps"]["age"].mean()
    assert 1 < age < 4
    assert f"{age:.1f} steps" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "entry"),
    [
        pytest.param("late_vmas", "age", marks=pytest.mark.slow),
        pytest.param("late_replay_buffer", "buffer", marks=pytest.mark.slow),
    ],
)
def test_an_example_runs(name, entry):
    pytest.importorskip("vmas")
    found = run(name)[entry]
    age = found[:]["age"] if entry == "buffer" else found
    assert 0.5 < age.mean() < 5


def test_workers_draw_the_same_delays_again_each_its_own():
    draw = load("transforms/late_workers")["draw"]
    one, other = draw(SerialEnv)
    assert one != other
    assert draw(SerialEnv) == [one, other]


def test_critics_learn_from_the_states_and_the_actor_from_what_it_knew():
    storage, _ = load("sac_backupdating")["train"](
        delay=6,
        frames=150,
        warm_up=120,
    )
    learnt = storage.steps[storage.latest()[:-6]]
    assert len(learnt) == 150 - 6
    assert learnt["next", "state"].equal(learnt["next", "observation"])
    assert learnt["known"][6:, :, :3].equal(learnt["state"][:-6])  # six steps old, then six actions
    assert learnt["known"][6:, :, -1:].equal((learnt["action"][5:-1] + 2) / 4)


@pytest.mark.slow
def test_worker_processes_draw_late_messages():
    run("late_workers")


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
    reader = pytest.importorskip("rerun.chunk").RrdReader
    rows = {}
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
        subprocess.run(
            command,
            cwd=tmp_path,
            env=os.environ | {"PATH": path},
            check=True,
        )
    assert len([*tmp_path.glob("runs/tune/*/result.csv")]) == 2
