"""The program that flies shows the flight of a journal of real UAVs instead."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from reports import write_journal

from damian.show.episode import Episode

PLACE = {"lon": -4.1290, "source spotted": False}
LINES = [
    {
        "received": 1.7e9 + second + late,
        "reports": [PLACE | {"ID": uav, "time": 1.7e9 + second, "lat": 52.811 + 1e-4 * second}],
    }
    for second in range(6)
    for uav, late in (("A", 0.2), ("B", 1.2))
]
"""Two UAVs that report their places for six seconds, the second one a second late."""


@pytest.mark.slow
def test_everything_is_made_of_a_journal_and_nothing_shows_a_source(run):
    write_journal(Path("north.jsonl"), *LINES, uavs=["A", "B"])
    words = ["journal=north.jsonl", "region=llanbedr", "delay=paper", "clock.simulation=0.5s"]
    folder = run(*words, "formats=[gif,geojson]", program="fly")
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
