"""A trained policy that is flown again, as a person does it: elsewhere, by others, under other delays."""

import csv
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import train
from evaluate import main
from helpers import check_refused
from omegaconf import OmegaConf
from shared.launch import launch

TRAINED = [
    "frames=64",
    "worlds=4",
    "learner.steps=8",
    "model.hidden=[16]",
    "eval_episodes=8",
    "episode.max_steps=10",
    "logger=csv",
    "seed=3",
    "delay.obs=1",
]


@pytest.fixture(scope="module")
def learnt(tmp_path_factory) -> Path:
    """The folder of a run with three UAVs."""
    folder = tmp_path_factory.mktemp("learnt") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["train.py", *TRAINED, f"hydra.run.dir={folder}"])
        launch(train.main)
    return folder


@pytest.fixture
def fly(learnt, tmp_path, monkeypatch) -> Callable[..., Path]:
    """Fly the policy of a run in an empty folder; returns where the results lie."""
    monkeypatch.chdir(tmp_path)

    def run_recipe(*overrides: str, of: Path | str | None = learnt, folder: str = "flown") -> Path:
        policy = [f"checkpoint={of}"] if of else []
        monkeypatch.setattr(sys, "argv", ["evaluate.py", *overrides, *policy, f"hydra.run.dir={folder}"])
        launch(main)
        return tmp_path / folder

    return run_recipe


def results(folder: Path) -> dict[str, dict[str, float]]:
    """Measures by policy."""
    with (folder / "result.csv").open(newline="") as file:
        return {
            row.pop("policy"): {name: float(x) for name, x in row.items()} for row in csv.DictReader(file)
        }


def test_it_is_flown_as_it_was_trained_if_nothing_else_is_asked_for(fly, learnt, capsys):
    folder = fly()
    assert {path.name for path in folder.iterdir()} == {"config.yaml", "result.csv", "result.md"}
    assert (folder / "result.md").read_text().strip() in capsys.readouterr().out
    again, before = results(folder), results(learnt)
    assert again.keys() == before.keys() == {"trained, sampled", "trained, mode", "random", "greedy"}
    assert again["trained, mode"] == before["trained, mode"]
    config, trained = (OmegaConf.load(path / "config.yaml") for path in (folder, learnt))
    differ = {name for name in trained if config[name] != trained[name]}
    assert differ == {"checkpoint", "overrides"}


def test_a_policy_trained_with_three_is_flown_with_ten(fly):
    folder = fly("agents=10", "eval_episodes=5")
    assert OmegaConf.load(folder / "config.yaml").agents == 10
    assert results(folder)["trained, mode"]["episodes"] == 5


def test_a_policy_of_sac_flies_as_one_of_mappo_does(fly, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["train.py", "learner=sac", *TRAINED, "hydra.run.dir=soft"])
    launch(train.main)
    assert results(fly("agents=5", of="soft")).keys() == {*results(tmp_path / "soft")}


def test_new_overrides_win_and_the_others_of_the_run_hold(fly):
    folder = fly("delay.obs=4", "seed=5")
    config = OmegaConf.load(folder / "config.yaml")
    assert (config.delay.obs, config.seed) == (4, 5)
    assert (config.episode.max_steps, config.eval_episodes, config.model.hidden) == (10, 8, [16])
    older, newer = (results(path)["random"]["age"] for path in (folder, fly(folder="trained")))
    assert older == pytest.approx((1 + 2 + 3 + 7 * 4) / 10, rel=1e-6)
    assert newer == 1


def test_several_delays_are_flown_in_one_sweep(fly, tmp_path):
    fly("-m", "delay.obs=0,2", "hydra.sweep.dir=sweep")
    tables = {
        OmegaConf.load(path.parent / "config.yaml").delay.obs: results(path.parent)
        for path in (tmp_path / "sweep").glob("*/result.csv")
    }
    assert tables.keys() == {0, 2}
    shares = {delay: (row["random"]["late"], row["random"]["lost"]) for delay, row in tables.items()}
    assert shares == {0: (0.0, 0.0), 2: (1.0, 0.0)}


def test_a_new_choice_of_a_group_wins_over_the_runs_keys_in_it(fly):
    folder = fly("delay=paper")
    assert OmegaConf.load(folder / "config.yaml").delay.obs.law == "uniform"


def test_a_run_that_was_resumed_is_flown_as_it_was_trained(fly, learnt, tmp_path, monkeypatch):
    resumed = shutil.copytree(learnt, tmp_path / "resumed")
    monkeypatch.setattr(sys, "argv", ["train.py", f"resume={resumed}", "frames=96"])
    launch(train.main)
    assert OmegaConf.load(fly(of=resumed) / "config.yaml").delay.obs == 1


def test_a_checkpoint_may_lie_in_a_folder_of_a_sweep(fly, learnt, tmp_path):
    swept = shutil.copytree(learnt, tmp_path / "agents=3,seed=3")
    assert OmegaConf.load(fly(of=f"'{swept}'") / "config.yaml").delay.obs == 1


def test_the_same_seed_gives_the_same_results_and_another_one_others(fly):
    one, same, other = fly(folder="one"), fly(folder="same"), fly("seed=4", folder="other")
    assert results(one) == results(same)
    assert results(one) != results(other)


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (["model.hidden=[8]"], "size mismatch for module.0.module.0.weight"),
        (["observation.local_features=[battery,spotted]"], "size mismatch for module.0.module.0.weight"),
        (["delay.history=2"], "size mismatch for module.0.module.0.weight"),
        (["actions=continuous"], "checkpoint: "),
        (["agent=3"], "agent: no such key; did you mean agents?"),
        (["delay.obs=-3"], "delay.obs: -3 is neither whole steps such as 3 nor a time"),
        (["agents=60"], "leaves room for 39 flight levels"),
        (["resume=nowhere"], "a resumed run keeps its configuration"),
    ],
)
def test_what_a_person_gets_wrong_is_one_line_and_leaves_nothing(fly, capsys, tmp_path, overrides, told):
    check_refused(lambda: fly(*overrides), told, capsys)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("policy", "told"),
    [(None, "checkpoint: it is missing"), ("nowhere", "checkpoint: nowhere/checkpoint: ")],
)
def test_without_a_policy_nothing_is_flown(fly, capsys, tmp_path, policy, told):
    check_refused(lambda: fly(of=policy), told, capsys)
    assert list(tmp_path.iterdir()) == []


def test_a_spoilt_checkpoint_is_refused(fly, learnt, capsys, tmp_path):
    spoilt = shutil.copytree(learnt, tmp_path / "spoilt")
    (spoilt / "checkpoint" / "manifest.json").write_text("{")
    check_refused(lambda: fly(of=spoilt), "checkpoint: ", capsys)
    shutil.rmtree(spoilt / "checkpoint")
    check_refused(lambda: fly(of=spoilt), "checkpoint: ", capsys)
    assert list(tmp_path.iterdir()) == [spoilt]


@pytest.mark.parametrize("text", ["a: [1", "- 1", "overrides: null"])
def test_a_spoilt_configuration_beside_a_checkpoint_is_refused(fly, learnt, capsys, tmp_path, text):
    spoilt = shutil.copytree(learnt, tmp_path / "spoilt")
    (spoilt / "config.yaml").write_text(text)
    check_refused(lambda: fly(of=spoilt), "config.yaml: ", capsys)
