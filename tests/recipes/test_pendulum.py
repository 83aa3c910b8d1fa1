"""The pendulum recipe: SAC on Pendulum-v1 with the delay transforms, run by its command line."""

import csv
import json
from pathlib import Path

import pytest
import torch
from torch import nn
from tqdm import tqdm

from damian.recipes import pendulum
from damian.recipes.pendulum import ARMS, Run, evaluate_under, main, make_env, make_learner, train

TINY = ["--seeds", "4", "--steps", "1002", "--episodes", "2", "--hidden", "8", "--delay", "3"]


def learn(delay: int, history: int, steps: int) -> nn.Module:
    """The policy that is trained with one seed."""
    torch.manual_seed(0)
    env = make_env(delay, history)
    env.set_seed(0)
    learner = make_learner(env, Run("history", 0, steps, delay, 20, 128))
    train(env, learner, steps, tqdm(disable=True))
    return learner.actor


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """The run folder of a comparison that two processes have finished."""
    folder = tmp_path_factory.mktemp("pendulum")
    main([*TINY, "--out", str(folder), "--jobs", "2"])
    return folder


@pytest.mark.slow
def test_the_table_lists_every_arm_beside_its_reference(folder):
    with (folder / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    arms = [(row["arm"], row["delay"]) for row in rows]
    assert arms == [*(("undelayed", d) for d in "023468"), ("naive", "3"), ("history", "3")]
    assert [row["reference"] for row in rows] == ["-145", "-153", "-324", "-757", "-777", "-977", "", ""]
    for row in rows:
        saved = json.loads((folder / f"seed4_{row['arm']}.json").read_text())
        assert row["seed 4"] == row["mean"] == f"{saved['returns'][row['delay']]:.0f}"
        assert f"| {' | '.join(row.values())} |" in (folder / "results.md").read_text()


@pytest.mark.slow
def test_finished_arms_are_kept_and_a_missing_one_is_reproduced_by_another_process(folder, capsys):
    files = [folder / f"seed4_{arm}.json" for arm in ARMS]
    before = [(file.stat().st_mtime_ns, file.read_text()) for file in files]
    files[1].unlink()
    main([*TINY, "--out", str(folder)])
    assert (folder / "results.md").read_text() in capsys.readouterr().out
    after = [(file.stat().st_mtime_ns, file.read_text()) for file in files]
    assert after[0] == before[0]
    assert after[2] == before[2]
    assert after[1][0] > before[1][0]
    assert after[1][1] == before[1][1]
    assert not list(folder.glob("*.part"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--steps", "1000"], "--steps: 1000 is not between 1001 and 1e+08"),
        (["--delay", "0"], "--delay: 0 steps is not between 1 and 200 steps"),
        (["--seeds", "0,x"], "--seeds: 0,x is not a list of different whole numbers"),
        (["--seeds", "1,01"], "--seeds: 1,01 is not a list of different whole numbers"),
        (["--jobs", "0"], "--jobs: 0 is not between 1 and 1024"),
        (["--episodes", "many"], "argument --episodes: invalid int value: 'many'"),
        (["--lag", "6"], "unrecognized arguments: --lag 6"),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        main(words)
    error = capsys.readouterr().err
    assert stopped.value.code == 2
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_folder_with_results_of_other_settings_is_refused(tmp_path, capsys):
    runs, _, _ = pendulum.parse(TINY)
    runs[0].file(tmp_path).write_text(json.dumps({**runs[0]._asdict(), "delay": 6, "returns": {}}))
    with pytest.raises(SystemExit):
        main([*TINY, "--out", str(tmp_path)])
    assert "--delay: 3 is not the 6 of" in capsys.readouterr().err


@pytest.mark.slow
def test_delay_lowers_the_return_and_the_action_history_restores_it():
    undelayed = learn(delay=0, history=0, steps=6_000)
    returns = {delay: evaluate_under(delay, 0, undelayed, 20) for delay in (0, 6)}
    assert returns[0] > -300
    assert returns[6] < returns[0] - 300
    naive = evaluate_under(6, 0, learn(delay=6, history=0, steps=12_000), 20)
    aware = evaluate_under(6, 6, learn(delay=6, history=6, steps=12_000), 20)
    assert aware > naive + 300
