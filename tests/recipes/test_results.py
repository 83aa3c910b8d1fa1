"""``damian.results`` reads the results of runs, sweeps and comparisons."""

import sys
from io import BytesIO, TextIOWrapper
from pathlib import Path

import pytest

import damian
from damian.common.errors import InputError
from damian.recipes.command import main


def test_results_are_utf_8_and_shown_also_where_the_locale_lacks_a_letter(tmp_path, monkeypatch):
    text = "policy,episodes,return\nŁąka,4,1.5\n"
    (tmp_path / "result.csv").write_text(text, "utf-8")
    printed = BytesIO()
    monkeypatch.setattr(sys, "stdout", TextIOWrapper(printed, encoding="ascii"))
    main(["results", str(tmp_path)])
    sys.stdout.flush()
    assert b"| \\u0141\\u0105ka |" in printed.getvalue()


def test_results_of_a_comparison_are_rows():
    folder = Path(__file__).parents[2] / "docs" / "results" / "delaybench"
    assert {*damian.results(folder)["method"]} >= {"undelayed", "backupdate"}
    with pytest.raises(InputError, match="no run has finished there"):
        damian.results(folder.parent / "none")
