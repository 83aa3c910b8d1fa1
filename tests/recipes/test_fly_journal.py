"""The program that flies shows the flight of a journal of real UAVs instead."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from reports import write_journal

from damian.recipes.fly import main
from damian.show.episode import Episode

WORDS = ["region=llanbedr", "delay=paper"]
LINES = [
    {
        "received": 1.7e9 + second + late,
        "reports": [
            {
                "ID": uav,
                "time": 1.7e9 + second,
                "source spotted": second == 3,
                "lat": 52.811 + 1e-4 * second,
                "lon": -4.1290,
                "battery": 100 - second,
            }
        ],
    }
    for second in range(6)
    for uav, late in (("A", 0.2), ("B", 1.2))
]
"""Two UAVs that report their places for six seconds, the second one a second late."""


@pytest.fixture
def show(tmp_path, monkeypatch):
    """Run the program on a journal of two UAVs in an empty folder; returns its run folder."""
    monkeypatch.chdir(tmp_path)
    write_journal(tmp_path / "north.jsonl", *LINES, uavs=["A", "B"])

    def run(*overrides: str) -> Path:
        words = ["journal=north.jsonl", "formats=[]", *WORDS, *overrides, "hydra.run.dir=run"]
        monkeypatch.setattr(sys, "argv", ["fly.py", *words])
        main()
        return tmp_path / "run"

    return run


@pytest.mark.slow
def test_everything_is_made_of_a_journal_and_nothing_shows_a_source(show):
    folder = show("formats=[gif,geojson]", "clock.simulation=0.5s")
    episode = Episode.load(folder / "episode_0.json")
    assert (episode.n_agents, episode.names, episode.source) == (2, ["A", "B"], None)
    assert np.diff(episode.time) == pytest.approx(0.5)
    about = dict(episode.about)
    assert (about["policy"], about["checkpoint"], about["fleet"]) == ("greedy", "runs/gone", "north")
    assert about["began"] == "2023-11-14T22:13:21.000Z", "when both had reported"
    with Image.open(folder / "episode_0.gif") as film:
        assert film.n_frames == episode.n_steps + 1
    features = json.loads((folder / "episode_0.geojson").read_text())["features"]
    kinds = [each["properties"]["kind"] for each in features]
    assert (kinds.count("track"), kinds.count("source track")) == (2, 0)
