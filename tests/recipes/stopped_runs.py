"""Runs of the training recipe that are stopped in the middle: in this process, or in a forked
child."""

import os
import signal
import sys
import threading
import time
import traceback
from contextlib import contextmanager

import pytest
import torch
from torch import Tensor
from tqdm import tqdm

from damian.recipes.train import main
from damian.runs.checkpoint import read_checkpoint
from damian.runs.metrics_log import MetricsLog

TINY = [
    "worlds=4",
    "learner.steps=8",
    "eval_episodes=2",
    "model.hidden=[8]",
    "checkpoint_every=3",
    "region.lattice_step=60",
    "episode.max_steps=12",
    "frames=256",
    "logger=csv",
]
SAC = ["learner=sac", "learner.updates=1", "learner.batch_size=16", "learner.warm_up=40"]
SAC += ["learner.buffer_steps=160"]
FINISHED = {
    "config.yaml",
    "run.json",
    "metrics.csv",
    "checkpoint.pt",
    "best.pt",
    "learning_curve.png",
}
FINISHED |= {"result.csv", "result.md"}


class Killed(BaseException):
    """Stops a run at once; no handler of the program knows it."""


@contextmanager
def at_each_update(act):
    """Act when the run inside has logged an update."""
    add = MetricsLog.add

    def add_and_act(log, frames, numbers):
        add(log, frames, numbers)
        act(log)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MetricsLog, "add", add_and_act)
        yield


@contextmanager
def killed_after(rows):
    """Stop the run inside when it has logged so many updates in all."""

    def stop(log):
        if len(log.rows) == rows:
            raise Killed

    with at_each_update(stop), pytest.raises(Killed):
        yield


@contextmanager
def counted_updates():
    """Count the updates that the run inside logs itself, without those of its checkpoint."""
    count = [0]

    def add_one(_):
        count[0] += 1

    with at_each_update(add_one):
        yield count


def forked(words, prepare=lambda: None):
    """Start the recipe with words in a forked child, which needs no second for imports; returns its
    id."""
    child = os.fork()
    if child:
        return child
    code = 130  # if a signal comes before the program has begun
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(
                number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
            )
        output = os.open("output.txt", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(output, 1)
        os.dup2(output, 2)
        sys.stdout = os.fdopen(1, "w", buffering=1)
        sys.stderr = os.fdopen(2, "w", buffering=1)
        tqdm.set_lock(threading.RLock())  # its own one is shared, and a killed child would keep it
        sys.argv = ["train.py", *words]
        prepare()
        code = 1
        main()
        code = 0
    except SystemExit as stopped:
        code = stopped.code if isinstance(stopped.code, int) else int(stopped.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def ended(child, limit=120.0):
    """Wait for a child; returns its exit code, or minus the signal that killed it."""
    until = time.monotonic() + limit
    while time.monotonic() < until:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    raise TimeoutError("the run did not end")


def stored(folder):
    """Every tensor of the checkpoint and of the best policy of a run, by path."""
    return {
        f"{name}.{path}": tensor
        for name in ("checkpoint.pt", "best.pt")
        for path, tensor in leaves(read_checkpoint(folder / name, "test"))
    }


def leaves(value, path=""):
    """Every tensor and number of nested dictionaries and lists, with its path."""
    if isinstance(value, dict):
        for key, each in value.items():
            yield from leaves(each, f"{path}.{key}")
    elif isinstance(value, list | tuple) and not isinstance(value, torch.Size):
        for i, each in enumerate(value):
            yield from leaves(each, f"{path}.{i}")
    elif isinstance(value, Tensor):
        yield path, value
    elif isinstance(value, int | float):
        yield path, torch.tensor(value, dtype=torch.float64)


def check_equal(whole, other):
    """Check that two runs have the same metrics, results, checkpoints and files, bit for bit."""
    for name in ("metrics.csv", "result.csv"):
        assert (other / name).read_bytes() == (whole / name).read_bytes(), name
    one = stored(whole)
    two = stored(other)
    assert one.keys() == two.keys()
    differ = [
        name for name in one if not torch.equal(one[name].nan_to_num(9), two[name].nan_to_num(9))
    ]
    assert differ == []
    assert files(other) == files(whole)
    assert {str(path) for path in FINISHED} <= files(whole)


def files(folder):
    """The files of a run folder."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
