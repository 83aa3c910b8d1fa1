"""The program that flies episodes: its files, and its refusals of wrong input."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from episodes import flight
from matplotlib.image import imread
from PIL import Image

from damian.show.episode import Episode
from damian.show.replay_page import page

SHORT = ["policy=random", "formats=[]", "actions.distances=[0,30,60]", "episode.max_steps=60"]
FLYING = ["motion=polynomial", "clock.simulation=1s"]
BADLY = ["delay=none", "delay.obs={law: uniform, low: 0, high: 5}", "delay.loss=0.3"]
"""Messages overtake each other and are lost, so that a short flight covers every case."""


@pytest.fixture
def fly(run):
    """Run the program with words in an empty folder; returns its run folder."""
    return partial(run, *SHORT, program="fly")


def printed_line(capsys):
    """The line about the episode."""
    (line,) = [
        line for line in capsys.readouterr().out.splitlines() if line.startswith("episode_0")
    ]
    return line


def test_a_run_folder_holds_configuration_episode_film_and_figure(fly, capsys):
    folder = fly(*BADLY, "agents=2", "episode.max_steps=2", "formats=[gif,png,html]")
    files = {"config.yaml", "run.json", "episode_0.json"}
    files |= {"episode_0.gif", "episode_0.png", "episode_0.html"}
    assert {path.name for path in folder.iterdir()} == files
    assert "2 steps" in printed_line(capsys)
    picture = imread(folder / "episode_0.png")
    assert picture.shape[1] == 1440
    assert len(np.unique(picture.reshape(-1, picture.shape[-1]), axis=0)) > 10
    with Image.open(folder / "episode_0.gif") as film:
        assert film.n_frames == 3
        assert film.size == (720, 690)


@pytest.mark.parametrize(
    ("motion", "crosses"),
    [
        ("instant", True),
        ("polynomial", False),
    ],
)
def test_a_note_says_that_instant_ways_cross_no_fly_zones(fly, capsys, motion, crosses):
    fly("region.zones=1", "episode.max_steps=2", f"motion={motion}", *FLYING[1:])
    assert (
        "note: with motion=instant nobody lands in a no-fly zone" in capsys.readouterr().out
    ) == crosses


@pytest.mark.slow
def test_the_policy_of_a_checkpoint_flies_with_the_settings_of_its_training(run, fly):
    words = [
        "agents=2",
        "frames=32",
        "worlds=2",
        "learner.steps=8",
        "model.hidden=[4]",
        "eval_episodes=2",
    ]
    words += ["actions.distances=[0,30,60]", "episode.max_steps=6", "delay.obs=2"]
    run(*words, folder="trained")
    words = ["policy=deterministic", "checkpoint=trained", "episode.max_steps=6"]
    folder = fly(*words, "eval_episodes=4", "keep=extremes", folder="flown")
    episodes = [Episode.load(folder / f"{name}.json") for name in ("worst", "median", "best")]
    assert all(episode.n_agents == 2 and episode.n_steps <= 6 for episode in episodes)
    assert all(episode.about["policy"] == "deterministic" for episode in episodes)
    returns = [episode.perceived_return for episode in episodes]
    assert returns == sorted(returns)
    one = fly(*words, folder="one")  # not as many as the training evaluated
    assert [path.name for path in one.glob("episode_*.json")] == ["episode_0.json"]


def test_what_the_server_believes_is_the_truth_as_old_as_the_episode_says(fly, capsys):
    """A lost message is never believed."""
    episode = Episode.load(fly(*BADLY, *FLYING) / "episode_0.json")
    step, uav = np.indices(episode.age.shape)
    generated = step - episode.age.astype(int)
    assert episode.age.max() > 3
    assert (episode.believed == episode.true[generated, uav]).all()
    believed = {(step, uav) for row in generated.tolist() for uav, step in enumerate(row)}
    lost = set(zip(*map(np.ndarray.tolist, np.nonzero(episode.lost)), strict=True))
    assert lost
    assert not lost & believed
    assert f"lost {len(lost) / episode.sent.sum():.1%}" in printed_line(capsys)


def test_a_page_has_the_episodes_in_the_order_of_their_files(run, capsys):
    for name in ("undelayed.json", "late.json"):
        flight(about={"overrides": [f"delay={name}"]}).save(Path(name))
    folder = run("replay=[undelayed.json,late.json]", program="fly", folder="page")
    text = (folder / "replay.html").read_text("utf-8")
    assert capsys.readouterr().out.startswith("page: page/replay.html (0.")
    assert text.index('"title":"delay=undelayed.json"') < text.index('"title":"delay=late.json"')
    assert len(text) < len(page([flight()])) + 10_000
