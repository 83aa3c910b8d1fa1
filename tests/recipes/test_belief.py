"""The belief recipe, run by its command line: its table, its figure, and its refusals of wrong input."""

import csv
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import check_refused
from matplotlib.image import imread
from omegaconf import OmegaConf

from damian.recipes.belief import main
from damian.recipes.shared.launch import launch

UNDELAYED = ["delay.obs=0", "delay.loss=0"]
FLYING = ["motion=polynomial", "clock.simulation=1s"]
BADLY = ["delay=none", "delay.obs={law: uniform, low: 0, high: 5}", "delay.loss=0.3"]
"""Messages overtake each other and are lost, so that a short flight covers every case."""


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Run the recipe with overrides in an empty folder; returns its run folder."""
    monkeypatch.chdir(tmp_path)

    def run_recipe(*overrides: str, folder: str = "run") -> Path:
        monkeypatch.setattr(sys, "argv", ["belief.py", *overrides, f"hydra.run.dir={folder}"])
        launch(main)
        return tmp_path / folder

    return run_recipe


def table(folder: Path) -> dict[str, np.ndarray]:
    """Columns of the table by name, [T + 1, N] each; positions [T + 1, N, 2]."""
    with (folder / "belief.csv").open(newline="") as file:
        rows = [{name: float(x) for name, x in row.items()} for row in csv.DictReader(file)]
    n_agents = OmegaConf.load(folder / "config.yaml").agents
    columns = {name: np.array([row[name] for row in rows]).reshape(-1, n_agents) for name in rows[0]}
    for kind in ("true", "believed"):
        columns[kind] = np.stack([columns[f"{kind}_east_m"], columns[f"{kind}_north_m"]], -1)
    return columns


def printed_lines(capsys) -> list[str]:
    """The lines that the recipe has printed, without the last one, which names the run folder."""
    *lines, last = capsys.readouterr().out.splitlines()
    assert last.startswith("results: ")
    return lines


@pytest.mark.parametrize(
    "overrides",
    [
        ["delay=none", "agents=1"],
        pytest.param([], marks=pytest.mark.slow),
        pytest.param([*BADLY, "scenario=tracking", "agents=8"], marks=pytest.mark.slow),
    ],
)
def test_a_run_folder_holds_configuration_table_and_figure(run, capsys, overrides):
    folder = run(*overrides, "episode.max_steps=10")
    assert {path.name for path in folder.iterdir()} == {"config.yaml", "run.json", "belief.csv", "belief.png"}
    assert [line.split(":")[0] for line in printed_lines(capsys)] == [
        "mean age",
        "late messages",
        "lost messages",
    ]
    picture = imread(folder / "belief.png")
    assert picture.shape[1] == 1400
    assert len(np.unique(picture.reshape(-1, picture.shape[-1]), axis=0)) > 10


def test_the_table_has_a_row_for_every_time_and_uav(run):
    columns = table(run("agents=2", "episode.max_steps=7", "clock.simulation=2s"))
    assert columns["time_s"].tolist() == [[2.0 * step] * 2 for step in range(8)]
    assert columns["uav"].tolist() == [[0, 1]] * 8


@pytest.mark.parametrize("motion", [[], FLYING])
@pytest.mark.parametrize("order", ["generation", "arrival"])
def test_the_belief_is_the_truth_as_old_as_the_table_says(run, motion, order):
    columns = table(run(*BADLY, *motion, f"delay.order={order}"))
    step, uav = np.indices(columns["age_s"].shape)
    generated = step - columns["age_s"].astype(int)
    assert columns["age_s"].max() > 3
    assert (columns["believed"] == columns["true"][generated, uav]).all()


@pytest.mark.parametrize("motion", [[], FLYING])
def test_without_delay_and_loss_the_server_holds_the_latest_message(run, capsys, motion):
    columns = table(run(*UNDELAYED, *motion))
    message_sent = columns["arrived"] == 1
    assert (columns["believed"] == columns["true"])[message_sent].all()
    assert (columns["age_s"] == 0)[message_sent].all()
    assert message_sent.all() == (motion == [])
    assert (columns["lost"] == 0).all()
    assert printed_lines(capsys)[1:] == ["late messages: 0.0%", "lost messages: 0.0%"]


def test_under_a_constant_delay_the_belief_is_the_truth_that_many_steps_ago(run, capsys):
    columns = table(run("delay.obs=3s", "clock.simulation=0.5s", "episode.max_steps=20"))
    age = np.minimum(columns["time_s"], 3.0)
    assert (columns["age_s"] == age).all()
    assert (columns["believed"][6:] == columns["true"][:-6]).all()
    assert columns["arrived"][:, 0].tolist() == [1] + [0] * 6 + [1] * 14
    assert printed_lines(capsys) == [
        f"mean age: {age.mean():.2f} s",
        "late messages: 100.0%",
        "lost messages: 0.0%",
    ]


def test_the_age_of_a_belief_grows_unless_a_message_arrives(run):
    columns = table(run(*BADLY, "clock.simulation=0.1s"))
    quiet = columns["arrived"][1:] == 0
    assert (np.diff(columns["age_s"], axis=0)[quiet].round(9) == 0.1).all()
    assert 0 < quiet.mean() < 1


def test_a_lost_message_is_never_believed(run, capsys):
    columns = table(run(*BADLY))
    generated = (columns["time_s"] - columns["age_s"]).astype(int)
    believed = {(step, uav) for row in generated for uav, step in enumerate(row)}
    lost = set(zip(*map(np.ndarray.tolist, np.nonzero(columns["lost"])), strict=True))
    assert lost
    assert not lost & believed
    share = len(lost) / columns["lost"][1:].size
    assert printed_lines(capsys)[2] == f"lost messages: {share:.1%}"


@pytest.mark.parametrize("motion", [[], FLYING])
def test_if_every_message_is_lost_none_arrives_and_only_sent_messages_count_as_lost(run, capsys, motion):
    columns = table(run("delay.obs=0", "delay.loss=1", *motion, "episode.max_steps=60"))
    assert columns["arrived"].tolist() == [[1] * 3] + [[0] * 3] * 60
    assert columns["lost"].any()
    assert columns["lost"][1:].all() == (motion == [])
    assert (columns["age_s"] == columns["time_s"]).all()
    assert printed_lines(capsys) == ["mean age: 30.00 s", "late messages: 0.0%", "lost messages: 100.0%"]


def test_the_same_seed_gives_the_same_flight_and_another_one_another(run):
    one, same, other = (
        run(*BADLY, f"seed={seed}", folder=folder) for seed, folder in ((0, "one"), (0, "same"), (1, "other"))
    )
    assert (one / "belief.csv").read_text() == (same / "belief.csv").read_text()
    assert (one / "belief.csv").read_text() != (other / "belief.csv").read_text()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["delai=burst"], "delai"),
        (["delay.los=0.1"], "delay.los: no such key; did you mean delay.loss?"),
        (["+delay.foo=3"], "delay.foo: no such key"),
        (["delay.obs=soon"], "delay.obs: soon is neither whole steps"),
        (["delay=sometimes"], "delay: sometimes is not one of burst, distance, lag, none, paper"),
        (["resume=runs/last"], "resume: the random policy flies, which is not trained"),
        (["region.id=Nope"], "Nope"),
    ],
)
def test_wrong_input_is_refused_in_one_line_and_leaves_no_folder(run, capsys, tmp_path, overrides, message):
    check_refused(lambda: run(*overrides), message, capsys)
    assert list(tmp_path.iterdir()) == []
