"""``damian.results`` reads the results of runs, sweeps and comparisons."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import damian
from damian.common.errors import InputError


def test_results_are_utf_8_whatever_the_locale_and_shown_also_where_it_lacks_a_letter(tmp_path):
    text = "policy,episodes,return\nŁąka,4,1.5\n"
    (tmp_path / "result.csv").write_text(text, encoding="utf-8")
    ascii_only = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    command = [sys.executable, "-c", "from damian.recipes.command import main; main()"]
    done = subprocess.run(
        [*command, "results", str(tmp_path)],
        env=os.environ | ascii_only,
        capture_output=True,
        encoding="ascii",
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "| \\u0141\\u0105ka |" in done.stdout


def test_results_of_a_comparison_are_rows():
    folder = Path(__file__).parents[2] / "docs" / "results" / "delaybench"
    assert {*damian.results(folder)["method"]} >= {"undelayed", "backupdate"}
    with pytest.raises(InputError, match="no run has finished there"):
        damian.results(folder.parent / "none")
