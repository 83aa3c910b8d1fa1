"""Submissions to the leaderboard: one is replayed, and what wrong ones are told."""

import json
import sys
from functools import cache
from pathlib import Path

import pandas as pd
import pytest
import torch
import yaml
from helpers import check_refused
from leaderboard import (
    WORDS,
    check_submission,
    delaybench,
    fingerprint,
    main as submit,
    words_of_tasks,
)

import damian
from damian.common.errors import InputError
from damian.common.tables import read_csv, write_csv
from damian.recipes.cli import settings
from damian.recipes.command import main
from damian.recipes.shared.runs import save_config
from damian.runs.checkpoint import write_checkpoint

ROOT = Path(__file__).parents[2]
LEADERBOARD = ROOT / "docs" / "results" / "leaderboard"
EXPERIMENT = cache(delaybench)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder of a comparison in which ``mine`` has five runs."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("leaderboard.delaybench", EXPERIMENT)
    monkeypatch.setattr(sys, "argv", ["leaderboard.py", "runs", "mine", "A. Author"])
    words = [
        "scenario=delaybench/crowded",
        "delay.obs={law: uniform, low: 1, high: 7}",
        "aware=timeline",
    ]
    config = settings(*words)
    rows = []
    for seed in range(8, 13):
        run = tmp_path / "runs" / "crowded" / "1-7" / "mine" / f"seed_{seed}"
        run.mkdir(parents=True)
        save_config(config, run)
        overrides = ["logger=csv", *words, f"seed={seed}"]
        record = {
            "damian": damian.__version__,
            "commit": "abc",
            "overrides": overrides,
            "wall_time_s": 1.0,
        }
        (run / "run.json").write_text(json.dumps(record))
        evaluated = {"policy": "trained", "return": 20.0 + seed, "episodes": 200.0}
        write_csv(run / "result.csv", pd.DataFrame([evaluated]))
        networks = {
            "actor": {"w": torch.zeros(3, 4)},
            "optimizer": {"w": torch.zeros(9)},
        }
        write_checkpoint(run / "checkpoint.pt", {"components": networks})
        label = {
            "task": "crowded",
            "delay": "1-7",
            "method": "mine",
            "seed": seed,
            "regime": "late data",
        }
        rows.append(label | evaluated | {"frames": 1e6, "return": 99.0})
    write_csv(tmp_path / "runs" / "results.csv", pd.DataFrame(rows))
    (tmp_path / "runs" / "curves.csv").write_text("task,delay,method,seed\n")
    return tmp_path / "runs"


def test_a_submission_holds_what_the_evaluations_of_the_runs_found(folder, capsys):
    submit()
    assert "mine.csv: 5 runs" in capsys.readouterr().out
    rows = read_csv(Path("mine.csv"), text=WORDS)
    assert rows["return"].tolist() == [28, 29, 30, 31, 32]
    assert set(rows["parameters"]) == {12}
    one = "scenario=delaybench/crowded 'delay.obs={law: uniform, low: 1, high: 7}' aware=timeline"
    assert set(rows["settings"]) == {one}
    other = fingerprint("scenario=delaybench/crowded", "delay.obs=4")
    assert (
        set(rows["fingerprint"])
        == {fingerprint(*words_of_tasks(EXPERIMENT())["crowded", "1-7"])}
        != {other}
    )
    Path("mine.csv").rename("submitted.csv")
    Path("mine.csv").symlink_to("outside")
    check_refused(submit, "mine.csv is a link", capsys)
    assert not Path("outside").exists()


def test_runs_of_another_task_or_without_their_folders_are_refused(folder, capsys):
    run = folder / "crowded/1-7/mine/seed_8"
    config = yaml.safe_load((run / "config.yaml").read_text())
    quiet = config["source"] | {"level_db": 120.0}
    for changed, told in (
        ({"frames": 20000}, "seed_8: frames: 20000 is not 1000000, as the task has it"),
        ({"source": quiet}, "seed_8: source.level_db: 120.0 is not 145"),
    ):
        (run / "config.yaml").write_text(yaml.safe_dump(config | changed))
        check_refused(submit, told, capsys)
    (run / "run.json").unlink()
    check_refused(submit, "seed_8 is not the folder of a finished run", capsys)


def test_runs_of_a_task_that_is_not_of_the_leaderboard_are_refused(folder, capsys):
    (folder / "crowded").rename(folder / "crowded_mini")
    table = folder / "results.csv"
    table.write_text(table.read_text().replace("crowded,", "crowded_mini,"))
    check_refused(submit, "task: crowded_mini is not of the leaderboard", capsys)


WRONG = {
    "seed: [0, 1, 2, 3, 4] are too few, or too small: run compare again": {"seed": range(5)},
    "task: crowded_mini is not of the leaderboard: train in one that is": {"task": "crowded_mini"},
    "mine.csv: regime: R0": {"regime": "R0"},
    "was a clone with changed files: commit them, then train": {"commit": "abc+changes"},
    "commit: it is empty: train in a clone": {"commit": None},
    "fingerprint: it is empty": {"fingerprint": float("nan")},
    "a number is not finite": {"return": float("nan")},
    "crowded/1-7: fingerprint: 0123456789ab is not ": {"fingerprint": "0123456789ab"},
}


def test_what_is_wrong_with_a_submission_is_said(folder):
    submit()
    rows = read_csv(Path("mine.csv"), text=WORDS)
    for told, changed in WRONG.items():
        with pytest.raises(InputError) as refused:
            check_submission(rows.assign(**changed), EXPERIMENT(), "mine.csv")
        assert told in str(refused.value)


def test_every_submission_of_the_leaderboard_is_whole():
    for path in LEADERBOARD.glob("*.csv"):
        check_submission(read_csv(path, text=WORDS), EXPERIMENT(), path.name)


@pytest.mark.slow
def test_a_comparison_of_few_steps_is_refused(tmp_path, monkeypatch, capsys):
    """As docs/delaybench.md tells it, with a few steps."""
    monkeypatch.chdir(ROOT)
    small = "['frames=64','worlds=2','learner.steps=8','eval_episodes=100']"
    what = [
        "tasks=[crowded]",
        "delays=['1-7']",
        "methods=[timeline]",
        f"overrides={small}",
        "seeds=5",
    ]
    main(["compare", "experiment=delaybench", *what, f"hydra.run.dir={tmp_path}/runs"])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["leaderboard.py", "runs", "timeline", "A. Author"])
    with pytest.raises(SystemExit):
        submit()
    assert "frames: 64 is not 1000000, as the task has it" in capsys.readouterr().err
