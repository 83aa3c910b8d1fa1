"""Faults around a run: a full disk, a folder in use, a learner that diverges, damaged folders,
signals."""

import os
import re
import resource
import shutil
import signal
import sys
from pathlib import Path

import pytest
from helpers import check_refused
from stopped_runs import TINY, at_each_update, ended, files, forked, killed_after

from damian.common.devices import keep_freed_memory
from damian.recipes import train
from damian.runs.checkpoint import read_checkpoint
from damian.runs.run_folder import locked


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """The folder of a run that was killed after its fourth update."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("begun")
        patch.chdir(folder)
        patch.setattr("sys.argv", ["train.py", *TINY, "seed=9", "hydra.run.dir=run"])
        with killed_after(4):
            train.main()
    return folder / "run"


@pytest.fixture
def copied(begun, tmp_path, monkeypatch):
    """A copy of that run as the folder ``run`` in the current one."""
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(begun, tmp_path / "run")


def updates_of(folder):
    """How many updates the checkpoint of a run has seen."""
    checkpoint = read_checkpoint(Path(folder, "checkpoint.pt"), "test")
    return checkpoint["training"]["progress"]["updates"]


def contents(folder):
    return {name: (folder / name).read_bytes() for name in files(folder)}


def test_a_folder_in_use_is_refused_and_stays_as_it_is(run, capsys, copied):
    before = contents(copied)
    with locked(copied):
        check_refused(lambda: run("resume=run"), "resume: run is in use by another run", capsys)
    assert contents(copied) == before


def test_a_full_disk_stops_a_run_in_one_line_and_keeps_its_checkpoint(copied):
    before = contents(copied)
    n_bytes = len(before["checkpoint.pt"]) // 2

    def fill():  # no file may grow beyond a size; Python ignores the signal
        resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, n_bytes))

    assert ended(forked(["resume=run", "hydra.run.dir=unused"], fill)) == 3
    output = Path("output.txt").read_text("utf-8")
    (error,) = [line for line in output.splitlines() if "error" in line.lower()]
    assert error.startswith("error: run/checkpoint.pt: it cannot be written: File too large")
    assert "Traceback" not in output
    after = contents(copied)
    changed = {name for name in after if after[name] != before.get(name)}
    assert changed <= {"metrics.csv", "run.json", "config.yaml"}


def test_freed_memory_is_used_again():
    keep_freed_memory()
    for _ in range(4):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        [b"x" * 2**24 for _ in range(8)]  # 16 MiB each
    assert resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before < 2**13


LATE = """
import torch
from damian import feature, reward_term

@feature("local")
def late(cache):
    return torch.where(cache.context.now.unsqueeze(-1) > 30, torch.nan, 0 * cache.messages.track)

@reward_term(reads=["spotted"])
def bad(features, counters):
    return torch.where(counters.steps.unsqueeze(-1) > 30, torch.nan, features["spotted"])
"""


NAN = {
    "observation.local_features=[spotted,late:late]": "feature late:late: a value is nan or infinite",
    "reward.custom=[{term: late:bad}]": "reward term bad: a value is nan or infinite",
}


@pytest.mark.parametrize("word", NAN)
def test_a_nan_is_blamed_on_what_made_it_and_not_on_the_learner(
    run, capsys, tmp_path, monkeypatch, word
):
    (tmp_path / "late.py").write_text(LATE)
    monkeypatch.delitem(sys.modules, "late", raising=False)
    with pytest.raises(SystemExit) as stopped:
        run(*TINY, word, "episode.max_steps=60", "frames=4000", folder="bad")
    assert stopped.value.code == 3
    line = capsys.readouterr().err.splitlines()[-1]
    intact = r"bad/checkpoint.pt is of update (\d+) and intact"
    told = re.fullmatch(rf"error: update \d+: {NAN[word]}; {intact}", line)
    assert updates_of("bad") == int(told[1])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda f: (f / "checkpoint.pt").unlink(),
            "checkpoint.pt: it cannot be read: No such file",
        ),
        (lambda f: (f / "config.yaml").write_text("agents: [\n"), "config.yaml: "),
        (
            lambda f: (f / "run.json").write_text('{"damian": "0.4.0"}'),
            "resume: run: damian 0.4.0 wrote it",
        ),
    ],
)
def test_a_damaged_folder_is_refused_in_one_line(run, capsys, copied, damage, message):
    damage(copied)
    names = files(copied)
    check_refused(lambda: run("resume=run"), message, capsys)
    assert files(copied) == names


def test_sigterm_stops_a_run_after_its_update(run, capsys):
    def signalled(log):
        if len(log.rows) == 2:
            os.kill(os.getpid(), signal.SIGTERM)

    with at_each_update(signalled), pytest.raises(SystemExit) as stopped:
        run(*TINY)
    assert stopped.value.code == 143
    assert capsys.readouterr().err.splitlines()[-1] == "interrupted; continue with resume=run"
    assert updates_of("run") == 2
