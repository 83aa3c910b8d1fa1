"""Collectors with several workers: the worlds of one process, seeds, weights, states, and lost workers."""

import itertools
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from stopped_runs import TINY, check_equal, killed_after, stored
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, set_exploration_type

from damian import keys
from damian.common.errors import InputError
from damian.recipes.cli import settings as composed_config
from damian.recipes.shared.collectors import (
    collecting,
    collector_parts,
    learning_env,
    worker_env,
    worker_seed,
)
from damian.recipes.shared.ray_cluster import connected_ray
from damian.recipes.train import make_learner, replay_buffer
from damian.runs.checkpoint import plain
from damian.settings import TrainConfig

TWO = ["collector=process", "workers=2"]
LATE = ["delay=paper", "aware=both", "delay.rew=2"]
LIMIT = 400
"""Seconds after which a run has hung."""


class ByMode(TensorDictModuleBase):
    """An actor that takes the most likely action, so that it draws nothing."""

    def __init__(self, actor: TensorDictModuleBase) -> None:
        super().__init__()
        self.actor, self.in_keys, self.out_keys = actor, actor.in_keys, actor.out_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return self.actor(tensordict)


@pytest.fixture
def forked() -> Iterator[None]:
    """Workers are forked, so that they need no seconds for imports."""
    before = torch.multiprocessing.get_start_method(allow_none=True)
    torch.multiprocessing.set_start_method("fork", force=True)
    yield
    torch.multiprocessing.set_start_method(before, force=True)


def settings(*words: str) -> TrainConfig:
    return composed_config(*TINY, *LATE, *words)


def actor_of(config: TrainConfig) -> TensorDictModuleBase:
    torch.manual_seed(7)
    env = learning_env(config)
    return make_learner(config, env, replay_buffer(config, env)).actor


def collected(
    config: TrainConfig, actor: TensorDictModuleBase, n: int, change: bool = False
) -> TensorDictBase:
    """n consecutive batches, [B, T]; ``change``: the actor's weights change after the first one."""
    batches = []
    with collecting(config, learning_env(config), actor) as collector:
        for batch in itertools.islice(collector, n):
            batches.append(batch.clone())
            if change and len(batches) == 1:
                with torch.no_grad():
                    for weight in actor.parameters():
                        weight.copy_(-weight)
    return torch.cat(batches, 1)


def unequal(one: TensorDictBase, other: TensorDictBase) -> list:
    """Keys whose entries differ; each worker counts its episodes by itself.

    What the actor computes may differ in its last bits: with fewer rows, some processors round the product of
    matrices in another way.
    """
    names = {key for key in one.keys(True, True) if "traj_ids" not in key}
    assert names == {key for key in other.keys(True, True) if "traj_ids" not in key}
    rounded = {keys.ACTION_LOG_PROB, (keys.AGENTS, "logits")}
    assert rounded <= names
    tolerance = {key: 1e-6 * (key in rounded) for key in names}
    apart = {key: (one[key].double() - other[key].double()).abs() for key in names}
    return [key for key in names if not (apart[key] <= tolerance[key]).all()]


def test_one_process_is_torchrls_collector_on_the_environment_itself():
    config = settings()
    env = learning_env(config)
    with collecting(config, env, actor_of(config)) as collector:
        assert type(collector) is Collector
        assert collector.env is env


def test_workers_step_the_worlds_of_one_process_by_the_newest_weights(forked):
    by_two, by_one = (collected(settings(*w), ByMode(actor_of(settings())), 3, True) for w in (TWO, []))
    assert unequal(by_two, by_one) == []
    assert by_two["next", "done"].any()
    unchanged = collected(settings(), ByMode(actor_of(settings())), 3)
    first = settings().learner.steps
    assert unequal(by_two[:, :first], unchanged[:, :first]) == []
    assert not by_two["agents", "action"].equal(unchanged["agents", "action"])


def test_back_updating_corrects_the_steps_of_workers_as_those_of_one_process(forked):
    stored = []
    for words in (TWO, []):
        config = settings(*words)
        buffer = replay_buffer(config, learning_env(config))
        batch = collected(config, ByMode(actor_of(settings())), 3)
        for part in batch.split(config.learner.steps, 1):
            buffer.extend(part)
        stored.append(buffer.storage.get(slice(None)))
    by_two, by_one = stored
    assert unequal(by_two, by_one) == []
    assert by_two["agents", "backupdated"].any()
    count = by_two["step_count"].squeeze(-1)
    follows = (count[1:] == count[:-1] + 1) | (count[1:] == 0)
    assert (~follows).any(1).sum() <= 1  # where the newest step is followed by the oldest


def test_what_a_checkpoint_reads_of_torchrls_collector_is_there():
    """``CarriedStep`` needs two private attributes, which another version of TorchRL may lack."""
    config = settings()
    with collecting(config, learning_env(config), actor_of(config)) as collector:
        next(iter(collector))
        step = collector_parts(collector)["collector"]
        stored = plain(step.state_dict())
        assert {*stored} == {"step", "trajectories"}
        step.load_state_dict(stored)
        assert next(iter(collector)).shape == (config.worlds, config.learner.steps)


def test_each_worker_is_a_plain_collector_with_a_seed_of_its_own(forked):
    config = settings(*TWO)
    actor = actor_of(config)
    batch = collected(config, actor, 2)
    for worker, own in enumerate(batch.split(config.worlds // 2)):
        with torch.random.fork_rng():
            env, steps = worker_env(config, actor, worker), config.learner.steps
            plain = Collector(
                env,
                actor,
                frames_per_batch=steps * config.worlds // 2,
                total_frames=-1,
                auto_register_policy_transforms=True,
            )
            expected = torch.cat([part.clone() for part in itertools.islice(plain, 2)], 1)
            plain.shutdown()
        assert unequal(own, expected) == []
    seeds = {worker_seed(seed, worker) for seed in range(50) for worker in range(50)}
    assert len(seeds) == 2500


@pytest.mark.slow
def test_a_stopped_run_with_workers_goes_on_as_if_it_had_not_been(run, forked):
    words = [*TINY, *LATE, *TWO]
    whole = run(*words, folder="whole")
    with killed_after(5):
        run(*words, folder="other")
    check_equal(whole, run("resume=other", folder="unused").with_name("other"))
    assert not multiprocessing.active_children()


@pytest.fixture
def started(tmp_path, monkeypatch) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Starts runs in processes of their own, as from the command line, with their output in a file."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    runs: list[subprocess.Popen[bytes]] = []

    def start(output: str, *words: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "damian.recipes.train", *words]
        with open(output, "w") as file:
            environment = os.environ | {"PYTHONUNBUFFERED": "1"}
            runs.append(subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT, env=environment))
        return runs[-1]

    yield start
    for run in runs:
        run.kill()
        run.wait()


def waited_for(path: str, pattern: str) -> re.Match[str]:
    """What a file has, once it has it."""
    until = time.monotonic() + LIMIT
    while not (found := re.search(pattern, Path(path).read_text() if Path(path).exists() else "")):
        assert time.monotonic() < until, f"{path} has no {pattern}"
        time.sleep(0.05)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["process", "ray"])
def test_a_run_that_lost_a_worker_and_was_resumed_equals_one_in_processes_that_lost_none(
    tmp_path, started, kind
):
    if kind == "ray":
        pytest.importorskip("ray")
    words = [*TINY, *LATE, "frames=800"]
    whole = started("whole.txt", *words, *TWO, "hydra.run.dir=whole")
    assert whole.wait(LIMIT) == 0
    cut = started("cut.txt", *words, f"collector={kind}", "workers=2", "hydra.run.dir=cut")
    number = int(waited_for("cut.txt", r"workers \(processes \d+, (\d+)\)")[1])
    waited_for("cut/metrics.csv", r"(.*\n){5}")
    os.kill(number, signal.SIGKILL)
    assert cut.wait(LIMIT) == 3
    error = waited_for("cut.txt", "error: (.*)")[1]
    assert error.startswith(f"collector: worker 1 of 2 (process {number}) was lost: ")
    assert error.endswith(", the latest; continue with resume=cut")
    assert started("resumed.txt", "resume=cut").wait(LIMIT) == 0
    for name in ("metrics.csv", "result.csv"):
        assert Path("cut", name).read_bytes() == Path("whole", name).read_bytes()
    one, two = (stored(tmp_path / name) for name in ("whole", "cut"))
    assert one.keys() == two.keys()
    differ = [name for name in one if not torch.equal(one[name].nan_to_num(9), two[name].nan_to_num(9))]
    assert [name for name in differ if ".random.python." not in name] == []  # Ray draws from it in between


def test_a_missing_ray_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"collector: ray is not installed; pip install 'damian\[ray\]'"):
        connected_ray("collector", 2)


def test_a_ray_that_does_not_start_is_one_line(monkeypatch):
    def fail(**_: Any) -> None:
        raise OSError("no memory to share")

    ray = ModuleType("ray")
    ray.__spec__ = ModuleSpec("ray", None)
    monkeypatch.setattr(ray, "is_initialized", lambda: False, raising=False)
    monkeypatch.setattr(ray, "init", fail, raising=False)
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    with pytest.raises(InputError, match="launcher: Ray does not start on this machine: no memory to share"):
        connected_ray("launcher", 2)
