"""The program that flies episodes, run by its command line: its files, and its refusals of wrong input."""

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import shapely
from episodes import flight
from helpers import check_refused
from matplotlib.image import imread
from PIL import Image
from shapely.geometry import shape

from damian.recipes.fly import main
from damian.recipes.train import main as train
from damian.show.episode import Episode
from damian.show.replay_page import page

SHORT = ["policy=random", "formats=[]", "actions.distances=[0,30,60]", "episode.max_steps=60"]
FLYING = ["motion=polynomial", "clock.simulation=1s"]
BADLY = ["delay=none", "delay.obs={law: uniform, low: 0, high: 5}", "delay.loss=0.3"]
"""Messages overtake each other and are lost, so that a short flight covers every case."""


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Run the program with overrides in an empty folder; returns its run folder."""
    monkeypatch.chdir(tmp_path)

    def run_recipe(*overrides: str, folder: str = "run") -> Path:
        monkeypatch.setattr(sys, "argv", ["fly.py", *SHORT, *overrides, f"hydra.run.dir={folder}"])
        main()
        return tmp_path / folder

    return run_recipe


@pytest.fixture
def flown(run):
    """Fly one episode with overrides; returns it as its file tells it."""
    return lambda *overrides: Episode.load(run(*overrides) / "episode_0.json")


def printed_line(capsys) -> str:
    """The line about the episode."""
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("episode_0")]
    return line


def test_a_run_folder_holds_configuration_episode_film_and_figure(run, capsys):
    folder = run(*BADLY, "agents=2", "episode.max_steps=4", "formats=[gif,png,html,geojson]")
    files = {"config.yaml", "run.json", "episode_0.json", "episode_0.geojson"}
    files |= {"episode_0.gif", "episode_0.png", "episode_0.html"}
    assert {path.name for path in folder.iterdir()} == files
    assert "4 steps" in printed_line(capsys)
    picture = imread(folder / "episode_0.png")
    assert picture.shape[1] == 1440
    assert len(np.unique(picture.reshape(-1, picture.shape[-1]), axis=0)) > 10
    with Image.open(folder / "episode_0.gif") as film:
        assert film.n_frames == 5
        assert film.size == (720, 660)


@pytest.mark.slow
def test_the_policy_of_a_checkpoint_flies_with_the_settings_of_its_training(run, monkeypatch, capsys):
    words = ["agents=2", "frames=32", "worlds=2", "learner.steps=8", "model.hidden=[4]", "eval_episodes=2"]
    words += ["actions.distances=[0,30,60]", "episode.max_steps=6", "delay.obs=2", "hydra.run.dir=trained"]
    monkeypatch.setattr(sys, "argv", ["train.py", *words])
    train()
    words = [
        "policy=deterministic",
        "checkpoint=trained",
        "eval_episodes=4",
        "keep=extremes",
        "episode.max_steps=6",
    ]
    folder = run(*words, folder="flown")
    episodes = [Episode.load(folder / f"{name}.json") for name in ("worst", "median", "best")]
    assert all(episode.n_agents == 2 and episode.n_steps <= 6 for episode in episodes)
    assert all(episode.about["policy"] == "deterministic" for episode in episodes)
    returns = [episode.perceived_return for episode in episodes]
    assert returns == sorted(returns)
    one = run(
        "policy=deterministic", "checkpoint=trained", folder="one"
    )  # not as many as the training evaluated
    assert [path.name for path in one.glob("episode_*.json")] == ["episode_0.json"]
    refusal = "flown/config.yaml: formats is not a setting of damian train: no policy was trained there"
    check_refused(lambda: run("policy=deterministic", "checkpoint=flown", folder="two"), refusal, capsys)


@pytest.mark.slow
def test_the_episodes_are_those_in_which_a_training_evaluates_its_policy(run, monkeypatch):
    flown = ["agents=2", "scenario=tracking", "delay=paper", "actions.distances=[0,30,60]", "eval_episodes=6"]
    words = ["frames=32", "worlds=2", "learner.steps=8", "model.hidden=[4]", "hydra.run.dir=trained"]
    monkeypatch.setattr(sys, "argv", ["train.py", *flown, *words, "episode.max_steps=20"])
    train()
    with Path("trained", "result.csv").open(encoding="utf-8", newline="") as file:
        measured = {row["policy"]: float(row["perceived_return"]) for row in csv.DictReader(file)}
    for policy, own in (("deterministic", ["checkpoint=trained"]), ("script", flown)):
        words = [*own, f"policy={policy}", "eval_episodes=6", "episode.max_steps=20"]
        folder = run(*words, folder=policy)
        returns = [Episode.load(folder / f"episode_{i}.json").perceived_return for i in range(6)]
        name = "trained, deterministic" if policy == "deterministic" else "script"
        assert np.mean(returns) == pytest.approx(measured[name], rel=1e-3)
    assert measured["script"] > 0


def test_what_the_server_believes_is_the_truth_as_old_as_the_episode_says(flown, capsys):
    """A lost message is never believed."""
    episode = flown(*BADLY, *FLYING)
    step, uav = np.indices(episode.age.shape)
    generated = step - episode.age.astype(int)
    assert episode.age.max() > 3
    assert (episode.believed == episode.true[generated, uav]).all()
    believed = {(step, uav) for row in generated.tolist() for uav, step in enumerate(row)}
    lost = set(zip(*map(np.ndarray.tolist, np.nonzero(episode.lost)), strict=True))
    assert lost
    assert not lost & believed
    assert f"lost {len(lost) / episode.sent.sum():.1%}" in printed_line(capsys)


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["policy=deterministic"], "policy: deterministic needs checkpoint"),
        (
            ["views=[]", "formats=[gif]"],
            "views: it names no view for the films",
        ),
        (["formats=[geojson]", "region=usecase"], "geojson: its region has no latitude and longitude"),
    ],
)
def test_wrong_input_is_refused_in_one_line_and_leaves_no_folder(run, capsys, tmp_path, overrides, message):
    check_refused(lambda: run(*overrides), message, capsys)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_real_region_with_a_hole_goes_from_file_to_film(run, tmp_path):
    square = np.array([[0.0, 0.0], [0.006, 0.0], [0.006, 0.004], [0.0, 0.004], [0.0, 0.0]])
    rings = [square + np.array([139.7, 35.6]), square / 4 + np.array([139.702, 35.601])]
    geometry = {"type": "Polygon", "coordinates": [each.tolist() for each in rings]}
    park = {"type": "Feature", "properties": {"name": "park"}, "geometry": geometry}
    (tmp_path / "park.geojson").write_text(json.dumps(park))
    words = ["region=geojson", "region.path=park.geojson", "region.lattice_step=40", "episode.max_steps=3"]
    folder = run(*words, "delay.obs=1", "formats=[gif,html,geojson]")
    episode = Episode.load(folder / "episode_0.json")
    assert all(episode.region.buffer(0.1).contains(shapely.Point(*place)) for place in episode.landing_points)
    written = json.loads((folder / "episode_0.geojson").read_text())
    (region,) = [each for each in written["features"] if each["properties"]["kind"] == "region"]
    given = shapely.Polygon(rings[0], [rings[1]])
    assert shape(region["geometry"]).symmetric_difference(given).area < 1e-3 * given.area
    degree = np.array([111_320 * np.cos(np.radians(35.6)), 110_900])
    area = shapely.transform(given, lambda corners: corners * degree).area
    assert episode.region.area == pytest.approx(area, rel=0.02)
    with Image.open(folder / "episode_0.gif") as film:
        assert film.n_frames == 4
    assert (folder / "episode_0.html").stat().st_size > 500_000


# Pages of stored episodes.


@pytest.fixture
def replay(tmp_path, monkeypatch):
    """Make a page of stored episodes; returns its run folder."""
    monkeypatch.chdir(tmp_path)
    for name in ("undelayed.json", "late.json"):
        flight(about={"overrides": [f"delay={name}"]}).save(tmp_path / name)

    def run_recipe(*words: str) -> Path:
        monkeypatch.setattr(sys, "argv", ["fly.py", *words, "hydra.run.dir=page"])
        main()
        return tmp_path / "page"

    return run_recipe


def test_a_page_has_the_episodes_in_the_order_of_their_files(replay, capsys):
    text = (replay("replay=[undelayed.json,late.json]") / "replay.html").read_text()
    assert capsys.readouterr().out.startswith("page: page/replay.html (0.")
    assert text.index('"title":"delay=undelayed.json"') < text.index('"title":"delay=late.json"')
    assert len(text) < len(page([flight()])) + 10_000
