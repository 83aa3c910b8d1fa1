"""The programs without a service, run by their command lines: tables, journals, and refusals."""

import csv
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from reports import write_journal

from damian.show.episode import Episode
from damian_fleet import offline

HEAD = "ID,source time,lat,lon,source spotted,track,takeoff-landing time,battery,AoI,FLA"
TABLE = f"""{HEAD}
A,NA,52.8110,-4.1283,0,90,NA,88,2,0
B,NA,52.8133,-4.1264,0,NA,NA,NA,0.5,0
C,NA,52.8154,-4.1311,1,180,NA,70,NA,NA
"""
SCRIPT = ["actions.distances=[0,30,60]", "region.initial_conditions=1"]


@pytest.fixture
def advise(tmp_path, monkeypatch):
    """Run the program on a table in an empty folder."""
    monkeypatch.chdir(tmp_path)
    Path("table.csv").write_text(TABLE, encoding="utf-8")

    def run(*words: str, program=offline.advise) -> Path:
        monkeypatch.setattr(sys, "argv", ["program", *words])
        program()
        return tmp_path

    return run


def test_a_table_is_answered_with_landing_points(advise, capsys):
    folder = advise(*SCRIPT, "table=table.csv")
    printed = capsys.readouterr().out
    table = (folder / "advice.csv").read_text(encoding="utf-8")
    assert printed == table
    rows = list(csv.DictReader(table.splitlines()))
    assert [row["ID"] for row in rows] == ["A", "B", "C"]
    assert [float(row["age"]) for row in rows] == [2.0, 0.5, 0.0]
    for row in rows:
        assert 52.80 < float(row["lat"]) < 52.83
        assert 0 <= float(row["distance"]) <= 60 + 30
    assert rows[2]["state"] == "hold", "who hears the source stays"


def test_a_trained_policy_answers_as_it_was_trained(advise, capsys):
    rows = TABLE.splitlines()
    Path("three.csv").write_text("\n".join(rows), encoding="utf-8")
    words = ["checkpoint=damian:tracking", "region=llanbedr", "table=three.csv"]
    with pytest.raises(SystemExit):
        advise(*words)
    assert capsys.readouterr().err.startswith(
        "error: motion: instant: the policy's UAVs were at their"
    )
    text = (advise(*words, "instant=true") / "advice.csv").read_text(encoding="utf-8")
    answer = list(csv.DictReader(text.splitlines()))
    assert [each["ID"] for each in answer] == ["A", "B", "C"]
    assert all(each["state"] in ("fly", "hold") for each in answer)


REFUSALS = [
    ([], "table: it is missing: give table=FILE"),
    (["table=nothing.csv"], "nothing.csv: no such file"),
    (
        ["table=table.csv", "links=updown"],
        "links: updown is not server: reports are what the server node",
    ),
    (["table=far.csv"], "far.csv: line 2: lat, lon: 48, 11 is "),
]


@pytest.mark.parametrize(
    ("words", "message"), REFUSALS, ids=[" ".join(words) for words, _ in REFUSALS]
)
def test_what_cannot_be_is_refused_in_one_line(advise, capsys, words, message):
    Path("far.csv").write_text("ID,lat,lon\nA,48,11\n", encoding="utf-8")
    with pytest.raises(SystemExit) as ended:
        advise(*words)
    (line,) = capsys.readouterr().err.splitlines()
    assert (ended.value.code, line.startswith(f"error: {message}")) == (2, True), line
    assert {path.name for path in Path().iterdir()} == {"table.csv", "far.csv"}


PLACE = {"lon": -4.1290, "source spotted": False}
LINES = [
    {
        "received": 1.7e9 + second + late,
        "reports": [PLACE | {"ID": uav, "time": 1.7e9 + second, "lat": 52.811 + 1e-4 * second}],
    }
    for second in range(6)
    for uav, late in (("A", 0.2), ("B", 1.2))
]
"""A journal of two UAVs that report their places for six seconds, the second one a second late."""


def test_everything_is_made_of_a_journal_and_nothing_shows_a_source(advise):
    write_journal(Path("north.jsonl"), *LINES, uavs=["A", "B"])
    words = [
        "journal=north.jsonl",
        "region=llanbedr",
        "delay=paper",
        "clock.simulation=0.5s",
        "folder=shown",
    ]
    folder = advise(*words, "formats=[gif]", program=offline.playback) / "shown"
    episode = Episode.load(folder / "episode_0.json")
    assert (episode.n_agents, episode.names, episode.source) == (2, ["A", "B"], None)
    assert np.diff(episode.time) == pytest.approx(0.5)
    about = dict(episode.about)
    assert (about["policy"], about["checkpoint"], about["fleet"]) == (
        "script",
        "runs/gone",
        "north",
    )
    assert about["began"] == "2023-11-14T22:13:21.000Z", "when both had reported"
    with Image.open(folder / "episode_0.gif") as film:
        assert film.n_frames == episode.n_steps + 1
