"""The examples of docs/interop.md run as they stand."""

import re
from pathlib import Path

import pytest

import damian

TEXT = (Path(damian.__file__).parents[1] / "docs" / "interop.md").read_text()
BLOCKS = re.findall(r"## ([^\n]+)\n(?:(?!\n## ).)*?```python\n(.*?)```", "## first\n" + TEXT, re.DOTALL)


def test_every_example_is_found():
    assert len(BLOCKS) == TEXT.count("```python") == 6


@pytest.mark.parametrize("code", [block for _, block in BLOCKS], ids=[title for title, _ in BLOCKS])
def test_an_example_runs(code, capsys):
    found = {}
    exec(code.replace("num_envs=256", "num_envs=4"), found)
    if "picture" in found:
        assert found["picture"].ndim == 3
    if "cart" in found:
        ages = [float(age) for age in re.findall(r"tensor\((\d+)", capsys.readouterr().out)]
        assert 1 <= ages[0] <= 8
        assert 3 <= ages[1] <= 9
