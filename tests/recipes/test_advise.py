"""The program that advises real UAVs, run by its command line: tables and its refusals."""

import csv
import json
from functools import partial
from pathlib import Path

import pytest
from helpers import check_refused

HEAD = "ID,source time,lat,lon,source spotted,track,takeoff-landing time,battery,AoI,FLA"
TABLE = f"""{HEAD}
A,NA,52.8110,-4.1283,0,90,NA,88,2,0
B,NA,52.8133,-4.1264,0,NA,NA,NA,0.5,0
C,NA,52.8154,-4.1311,1,180,NA,70,NA,NA
"""
SCRIPT = ["policy=script", "actions.distances=[0,30,60]", "region.initial_conditions=1"]


@pytest.fixture
def advise(run):
    """Run the program on a table in an empty folder; returns its run folder."""
    Path("table.csv").write_text(TABLE, encoding="utf-8")
    return partial(run, program="advise")


def test_a_table_is_answered_with_landing_points_as_csv_and_json(advise, capsys):
    folder = advise(*SCRIPT, "table=table.csv")
    printed = capsys.readouterr().out
    files = {"config.yaml", "run.json", "advice.csv", "advice.json"}
    assert {path.name for path in folder.iterdir()} == files
    table = (folder / "advice.csv").read_text()
    assert printed.startswith(table)
    rows = list(csv.DictReader(table.splitlines()))
    assert [row["ID"] for row in rows] == ["A", "B", "C"]
    assert [float(row["age"]) for row in rows] == [2.0, 0.5, 0.0]
    for row, there in zip(rows, json.loads((folder / "advice.json").read_text()), strict=True):
        assert 52.80 < float(row["lat"]) < 52.83
        assert 0 <= float(row["distance"]) <= 60 + 30
        assert (row["state"], float(row["lon"])) == (there["state"], there["lon"])
    assert rows[2]["state"] == "hold", "who hears the source stays"


def test_a_trained_policy_answers_as_it_was_trained(run, advise, capsys):
    words = ["agents=2", "frames=32", "worlds=2", "learner.steps=8", "model.hidden=[4]", "eval_episodes=2"]
    words += ["actions.distances=[0,30,60]", "episode.max_steps=6", "delay.obs=2", "delay.history=2"]
    run(*words, folder="trained")
    rows = TABLE.splitlines()
    Path("two.csv").write_text("\n".join(rows[:3]), encoding="utf-8")
    words = ["checkpoint=trained", "table=two.csv"]
    for word in ("motion=instant", "motion=polynomial"):  # what is given now does not change the training
        check_refused(lambda word=word: advise(*words, word), "motion: instant: ", capsys)
    answer = json.loads((advise(*words, "instant=true") / "advice.json").read_text())
    assert [each["ID"] for each in answer] == ["A", "B"]
    assert all(each["state"] in ("fly", "hold") for each in answer)


REFUSALS = [
    (["policy=script"], "table: it is missing: give table=FILE"),
    (["table=nothing.csv"], "nothing.csv: no such file"),
    (["table=table.csv", "links=updown"], "links: updown is not server: reports are what the server node"),
    (["table=far.csv"], "far.csv: line 2: lat, lon: 48, 11 is "),
]


@pytest.mark.parametrize(("words", "message"), REFUSALS, ids=[" ".join(words) for words, _ in REFUSALS])
def test_what_cannot_be_is_refused_in_one_line(advise, capsys, words, message):
    Path("far.csv").write_text("ID,lat,lon\nA,48,11\n", encoding="utf-8")
    check_refused(lambda: advise(*words), message, capsys)
    assert {path.name for path in Path().iterdir()} <= {"table.csv", "far.csv", "run"}
