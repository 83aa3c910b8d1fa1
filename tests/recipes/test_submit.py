"""Submissions to the leaderboard: one is replayed, and what wrong ones are told."""

import json
from pathlib import Path

import pandas as pd
import pytest
import torch

from damian.common.errors import InputError
from damian.common.tables import read_csv, write_csv
from damian.compare.leaderboard import WORDS, check_submission, leaderboard
from damian.recipes.command import main
from damian.recipes.submit import delaybench
from damian.runs.checkpoint import write_checkpoint

ROOT = Path(__file__).parents[2]
LEADERBOARD = ROOT / "docs" / "results" / "leaderboard"
SUBMIT = ["submit", "folder=runs", "method=mine", "authors=A. Author"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder of a comparison in which ``mine`` has five runs."""
    monkeypatch.chdir(tmp_path)
    rows = []
    for seed in range(8, 13):
        run = tmp_path / "runs" / "crowded" / "1-7" / "mine" / f"seed_{seed}"
        run.mkdir(parents=True)
        record = {"damian": "0.18.0", "commit": "abc", "command": "damian compare", "wall_time_s": 1.0}
        (run / "run.json").write_text(json.dumps(record))
        evaluated = {"policy": "trained", "return": 20.0 + seed, "episodes": 200.0}
        write_csv(run / "result.csv", pd.DataFrame([evaluated]))
        networks = {"actor": {"w": torch.zeros(3, 4)}, "optimizer": {"w": torch.zeros(9)}}
        write_checkpoint(run / "checkpoint.pt", {"components": networks})
        label = {"task": "crowded", "delay": "1-7", "method": "mine", "seed": seed, "regime": "late data"}
        rows.append(label | evaluated | {"frames": 1e6, "return": 99.0})
    write_csv(tmp_path / "runs" / "results.csv", pd.DataFrame(rows))
    (tmp_path / "runs" / "curves.csv").write_text("task,delay,method,seed\n")
    return tmp_path / "runs"


def test_a_submission_holds_what_the_evaluations_of_the_runs_found(folder, capsys):
    main(SUBMIT)
    assert "mine.csv: 5 runs" in capsys.readouterr().out
    rows = read_csv(Path("mine.csv"), text=WORDS)
    assert rows["return"].tolist() == [28, 29, 30, 31, 32]
    assert set(rows["parameters"]) == {12}
    table = leaderboard([rows], ["1-7", "4"])
    assert "## crowded, late data" in table
    assert "| mine | 30.0 [" in table
    assert "A. Author | 1 | 12 | 0.18.0 (abc) |" in table


def test_a_submission_without_the_folders_of_its_runs_is_refused(folder, capsys):
    (folder / "crowded/1-7/mine/seed_9/run.json").unlink()
    with pytest.raises(SystemExit):
        main(SUBMIT)
    assert "seed_9 is not the folder of a finished run" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("column", "value", "told"),
    [
        ("seed", range(5), "seed: [0, 1, 2, 3, 4] are not 5 or more from 8 on"),
        ("seed", 8, "are not all different"),
        ("task", "mine", "mine.csv: task: mine"),
        ("regime", "R0", "mine.csv: regime: R0"),
        ("commit", "abc+changes", "has changes: commit them"),
        ("commit", "", "commit: it is empty"),
        ("return", float("nan"), "a number is not finite"),
        ("episodes", 20.0, "episodes: 20 is not at least 100"),
    ],
)
def test_what_is_wrong_with_a_submission_is_said(folder, column, value, told):
    main(SUBMIT)
    rows = read_csv(Path("mine.csv"), text=WORDS).assign(**{column: value})
    with pytest.raises(InputError) as refused:
        check_submission(rows, delaybench(), "mine.csv")
    assert told in str(refused.value)


def test_every_submission_of_the_leaderboard_is_whole():
    for path in LEADERBOARD.glob("*.csv"):
        check_submission(read_csv(path, text=WORDS), delaybench(), path.name)


@pytest.mark.slow
def test_a_comparison_is_submitted(tmp_path, monkeypatch):
    """As docs/delaybench.md tells it, with a few steps."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr("damian.runs.run_record.commit", lambda: "abc")  # files may change meanwhile
    small = "['frames=64','worlds=2','learner.steps=8','eval_episodes=100','episode.max_steps=2']"
    what = ["tasks=[crowded]", "delays=['1-7']", "methods=[undelayed,timeline]", f"overrides={small}"]
    main(["compare", "experiment=delaybench", "seeds=5", *what, f"hydra.run.dir={tmp_path}/runs"])
    monkeypatch.chdir(tmp_path)
    main(["submit", "folder=runs", "method=timeline", "authors=A. Author"])
    assert len(read_csv(Path("timeline.csv"), text=WORDS)) == 10  # of three UAVs, and flown with four
