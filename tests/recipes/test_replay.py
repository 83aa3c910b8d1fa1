"""The program that makes a page of stored episodes, run by its command line."""

import json

import pytest
from episodes import flight
from helpers import check_refused

from damian.recipes.replay import main
from damian.show.replay_page import MOST, page


@pytest.fixture
def stored(tmp_path, monkeypatch):
    """The names of two files with episodes, in the current folder."""
    monkeypatch.chdir(tmp_path)
    names = ["undelayed.json", "late.json"]
    for name in names:
        flight(about={"overrides": [f"delay={name}"]}).save(tmp_path / name)
    return names


@pytest.mark.parametrize("words", [[], ["--out", "both.html"]])
def test_the_page_has_the_episodes_in_the_order_of_their_files(stored, tmp_path, capsys, words):
    main([*stored, *words])
    out = tmp_path / (words[-1] if words else "replay.html")
    assert capsys.readouterr().out.startswith(f"page: {out.name} (0.")
    text = out.read_text()
    assert text.index('"title":"delay=undelayed.json"') < text.index('"title":"delay=late.json"')
    assert len(text) < len(page([flight()])) + 10_000


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "the following arguments are required: EPISODE.json"),
        (["--speed", "3"], "--speed"),
        (["missing.json"], "missing.json: it is no episode of version 1 or 2: no such file"),
        (["late.json"] * (MOST + 1), f"EPISODE.json: {MOST + 1} is not between 1 and {MOST}"),
        (
            ["late.json", "--out", "undelayed.json"],
            "--out: undelayed.json is no page: its name must end in .html",
        ),
        (["late.json", "--out", "nowhere/page.html"], "--out: nowhere/page.html: it cannot be written"),
        (["late.json", "--out", "x" * 5000 + ".html"], "File name too long"),
        (["late.json", "--out", "a\0b.html"], "--out: "),
    ],
    ids=lambda part: str(part)[:30],
)
def test_wrong_input_is_refused_in_one_line_and_leaves_no_page(stored, tmp_path, capsys, words, message):
    check_refused(lambda: main(words), message, capsys)
    assert {path.name for path in tmp_path.iterdir()} == {*stored}


def test_a_file_with_numbers_that_json_cannot_hold_is_refused(stored, tmp_path, capsys):
    held = json.loads((tmp_path / "late.json").read_text())
    (tmp_path / "late.json").write_text(json.dumps({**held, "about": {"seed": float("inf")}}))
    check_refused(lambda: main(["late.json"]), "not JSON compliant", capsys)
