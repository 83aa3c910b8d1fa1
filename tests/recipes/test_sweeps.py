"""Sweeps: each run stands alone, the same command goes on, and the table pairs by seed."""

import json
import math
import shutil
import sys
from pathlib import Path

import pandas as pd
import pytest
from helpers import SMALLEST_TRAINING
from stopped_runs import counted_updates, killed_after

import damian
from damian.common.errors import InputError
from damian.compare.paired import difference
from damian.compare.statistics import probability_of_improvement
from damian.learners.mappo import Mappo
from damian.recipes import cli
from damian.recipes.command import main
from damian.recipes.shared.runs import Run
from damian.recipes.shared.sweeps import perform_all

TINY = [*SMALLEST_TRAINING, "logger=csv", "agents=1"]


@pytest.fixture
def sweep(tmp_path, monkeypatch, few_figures):
    """Sweep in an empty folder; returns the exit code."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [])

    def run(*words, program="train"):
        try:
            main([program, "-m", *(TINY if program == "train" else []), *words])
        except SystemExit as stopped:
            return stopped.code
        return 0

    return run


def test_a_refused_or_diverged_run_is_a_row_and_the_others_go_on(sweep, capsys, monkeypatch):
    learn = Mappo.learn

    def diverge(learner, batch):
        return learn(learner, batch) | (
            {"loss_critic": math.inf} if learner.config.lr > 0.1 else {}
        )

    monkeypatch.setattr(Mappo, "learn", diverge)
    words = ["delay.obs=-1,1", "learner.lr=1e-3,0.99"]
    assert sweep(*words, "hydra.sweep.dir=all") == 1
    printed = capsys.readouterr()
    finished = sorted(file.parent.name for file in Path("all").glob("*/result.csv"))
    failed = {
        file.parent.name: json.loads(file.read_text()) for file in Path("all").glob("*/failed.json")
    }
    assert len(failed) == 3
    assert finished == ["delay.obs-1_learner.lr-0.001"]
    assert "the learner has diverged" in failed["delay.obs-1_learner.lr-0.99"]["error"]
    refused = failed["delay.obs--1_learner.lr-0.001"]
    assert refused["error"].startswith("delay.obs: -1 is not a delay")
    table = Path("all/table.md").read_text("utf-8")
    assert table in printed.out
    assert all(f"| {name} | {each['error'][:40]}" in table for name, each in failed.items())
    assert f"failed: all/delay.obs--1_learner.lr-0.001: {refused['error']}" in printed.err


@pytest.mark.slow
def test_the_same_command_goes_on_with_what_is_missing_after_a_kill(sweep, capsys):
    words = ["seed=0,1", "delay.obs=1..3", "frames=160", "checkpoint_every=2"]
    with killed_after(3):  # in the first run
        sweep(*words)
    (folder,) = Path("runs").iterdir()
    assert [path.name for path in folder.glob("*/checkpoint.pt")] == ["checkpoint.pt"]
    with counted_updates() as updates:
        assert sweep(*words) == 0
    assert updates == [3 + 5]  # two of the first run were in its checkpoint
    shutil.rmtree(folder / "seed-1")
    with counted_updates() as updates:
        assert sweep(*words) == 0
    assert updates == [5]
    assert [*Path("runs").iterdir()] == [folder]
    assert "| trained | 2 |" in capsys.readouterr().out.rpartition("results of the sweep")[2]
    (folder / "seed-1" / "config.yaml").write_text((folder / "seed-0" / "config.yaml").read_text())
    assert sweep(*words) == 1
    error = json.loads((folder / "seed-1" / "failed.json").read_text())["error"]
    assert "seed-1: seed is 0 in this stored run, and 1 is asked for: delete the folder" in error


def test_of_many_runs_one_that_fails_is_kept_and_the_others_go_on(tmp_path):
    done = []

    def work(config, folder):
        done.append(folder.name)
        if folder.name == "wrong" and len(done) < 4:
            raise InputError("frames: of the user's own code")
        (folder / "result.csv").touch()

    config = cli.settings("agents=1")
    names = ["first", "wrong", "last"]
    runs = [Run(work, config, tmp_path / name) for name in names]
    runs.append(
        Run(
            work,
            config,
            tmp_path / "later",
            needs=tmp_path / "wrong",
            stage=1,
        )
    )
    assert [run.folder.name for run in perform_all(runs, 1)] == ["wrong", "later"]
    told = [
        json.loads((tmp_path / name / "failed.json").read_text())["error"]
        for name in ("wrong", "later")
    ]
    assert told == [
        "frames: of the user's own code",
        f"checkpoint: {tmp_path}/wrong has no finished policy",
    ]
    assert told[0] in (tmp_path / "wrong" / "log.txt").read_text()
    assert perform_all(runs, 1) == []
    assert done == [*names, "wrong", "later"]
    assert not [*tmp_path.glob("*/failed.json")]


def test_a_table_shows_differences_to_the_first_value_paired_by_seed(sweep, capsys):
    words = ["aware=none,backupdate", "delay.obs=1..3", "seed=0,1", "frames=32"]
    assert sweep(*words, "hydra.sweep.dir=sweep") == 0
    table = capsys.readouterr().out.rpartition("results of the sweep")[2]
    rows = damian.results("sweep")
    trained = rows[rows["policy"] == "trained"].pivot(
        index="seed", columns="aware", values="return"
    )
    mean = (trained["backupdate"] - trained["none"]).mean()
    assert (trained.loc[0] != trained.loc[1]).all(), "another seed, another run"
    (line,) = [line for line in table.splitlines() if line.startswith("| backupdate | trained |")]
    *_, shown, better = line.removesuffix(" |").split(" | ")
    assert float(shown.split()[0]) == pytest.approx(mean, abs=6e-4)
    expected = probability_of_improvement(
        trained["backupdate"].to_numpy(), trained["none"].to_numpy()
    )
    assert float(better.split()[0]) == pytest.approx(expected, abs=6e-4)
    assert float(line.split(" | ")[3].split()[0]) == pytest.approx(
        trained["backupdate"].mean(), abs=6e-4
    )
    (first,) = [line for line in table.splitlines() if line.startswith("| none | trained |")]
    assert first.endswith("| - | - |")
    assert "return to that of aware=none, paired by seed" in table
    for aware in ("none", "backupdate"):  # two folders, as two sweeps
        Path(aware).mkdir()
        for folder in Path("sweep").glob(f"aware-{aware}_*"):
            shutil.copytree(folder, Path(aware, folder.name))
    main(["results", "none", "backupdate"])
    (again,) = [
        x for x in capsys.readouterr().out.splitlines() if x.startswith("| backupdate | trained |")
    ]
    assert again == line


def test_a_difference_takes_only_seeds_that_both_have():
    runs = pd.DataFrame(
        {
            "seed": [0, 1, 2, 5],
            "return": [3.0, 5.0, 4.0, 99.0],
            "steps": [1, 2, 3, 0],
        }
    )
    others = pd.DataFrame(
        {
            "seed": [2, 1, 0],
            "return": [3.5, 4.0, 1.0],
            "steps": [4.0, 5.0, 6.0],
        }
    )
    found = difference(runs, others, "return")
    assert found["difference"] == pytest.approx((2 + 1 + 0.5) / 3)
    assert found["difference_low"] < found["difference"] < found["difference_high"]
    assert difference(runs, others, "steps")["improvement"] == 1  # fewer are better
    assert difference(runs, others.assign(seed=[7, 8, 9]), "return") == {}


@pytest.mark.slow
def test_a_sweep_evaluates_runs_of_other_folders_as_they_are_now(sweep):
    for seed in (0, 1):
        main(["train", *TINY, f"seed={seed}", f"hydra.run.dir=trained/{seed}"])
    words = ["checkpoint=trained/0,trained/1", "delay.obs=2..4", "hydra.sweep.dir=flown"]
    assert sweep(*words, program="evaluate") == 0
    names = {path.parent.name for path in Path("flown").glob("*/result.csv")}
    assert names == {"checkpoint-trained-0", "checkpoint-trained-1"}
    before = {path: path.stat().st_mtime_ns for path in Path("flown").glob("*/result.csv")}
    shutil.copy("trained/1/checkpoint.pt", "trained/0/checkpoint.pt")
    assert sweep(*words, program="evaluate") == 0
    again = {path.parent.name for path, when in before.items() if path.stat().st_mtime_ns != when}
    assert again == {"checkpoint-trained-0"}, "the policy that is there now was flown"


def test_names_of_folders_are_short_and_can_be_typed():
    law = "delay.obs={law:lag,lag:{law:uniform,low:0,high:6},update_period:20,stagger:true,shared:true}"
    sweep = ["seed=0,1", law, "scenario=a/b,c"]
    words = ["seed=0", law, "scenario=a/b"]
    assert cli._run_name(sweep, words) == "seed-0_scenario-a-b"
    assert cli._run_name([f"{law},0"], [law]) != cli._run_name(
        [f"{law},0"], [law.replace("20", "21")]
    )
    assert len(cli._run_name([f"{law},0"], [law])) < 100
    assert cli._sweep_name(sweep) != cli._sweep_name([*sweep, "frames=7"])


@pytest.mark.slow
def test_a_sweep_in_several_processes_goes_on_and_ends_with_its_table_too(sweep):
    words = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "delay.obs=-1,1", "seed=0,1"]
    for _ in range(2):
        assert sweep(*words) == 1
        (folder,) = Path("runs").iterdir()
        assert len([*folder.glob("*/result.csv")]) == len([*folder.glob("*/failed.json")]) == 2
        assert "is not a delay" in (folder / "table.md").read_text()
