"""The documents keep their word: their Python runs, their commands exist, their links lead
somewhere."""

import re
import shlex

import pytest
import yaml
from leaderboard_pages import leaderboard_pages
from sites import ROOT, anchors, links

import damian
from damian.recipes.command import FOLDERS, PROGRAMS
from damian.recipes.known import check_words

DOCUMENTS = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]
DOCUMENTS = sorted(
    [*DOCUMENTS, *(ROOT / "examples").rglob("*.md"), *(ROOT / "damian" / "data").rglob("*.md")]
)
FILES = [
    file for file in DOCUMENTS if file.name != "CHANGELOG.md"
]  # which names commands of older versions
FILES += [*(ROOT / "conf").rglob("*.yaml"), *(ROOT / "examples").rglob("*.py")]
FILES += sorted((ROOT / "recipes").glob("*.py"))


def test_the_readmes_python_runs(capsys):
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    exec(block, {})
    late, corrected = map(float, re.findall(r"tensor\(([\d.]+)\)", capsys.readouterr().out))
    assert late < 0.1
    assert 0.9 < corrected < 1


def commands(file):
    """The commands that a file names: program and words."""
    text = file.read_text("utf-8").replace("\\\n", "")
    for line in re.findall(r"(?:^[ #]*|`)damian ([a-z]+ [^`\n|]*)", text, re.MULTILINE):
        command = re.split(r"  +[#(]", line)[0]  # an explanation stands behind some spaces
        name, *words = shlex.split(command, comments=True)
        yield name, words


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_every_command_that_a_file_names_exists(file):
    for name, words in commands(file):
        line = shlex.join([name, *words])
        assert name in PROGRAMS, line
        own = [
            word
            for word in words
            if re.match(r"[\w.]+=", word) and not re.search("FOLDER|NAME", word)
        ]
        if name not in FOLDERS and not any(
            word.startswith(("--help", "--config-dir")) for word in words
        ):
            check_words(name, own)


@pytest.mark.parametrize("file", DOCUMENTS, ids=lambda file: str(file.relative_to(ROOT)))
def test_every_link_and_anchor_of_a_document_leads_somewhere(file):
    nowhere = []
    for link in links(file.read_text("utf-8")):
        path, _, anchor = link.partition("#")
        target = file.parent / path if path else file
        there = target.exists() and (not anchor or anchor in anchors(target.read_text("utf-8")))
        nowhere += [] if there else [link]
    assert nowhere == []


def test_the_numbers_of_the_guide_to_methods_are_those_of_the_results():
    guide = (ROOT / "docs" / "methods.md").read_text("utf-8")
    results = "".join((ROOT / name).read_text("utf-8") for name in ("RESULTS.md", "docs/report.md"))
    numbers = {*re.findall(r"-?\d+\.\d|-\d{3,}", guide)}
    assert len(numbers) > 20
    assert [
        number for number in numbers if not re.search(rf"(?<![\d.]){number}(?![\d.]\d)", results)
    ] == []


def test_the_leaderboard_is_that_of_the_stored_results():
    pages = leaderboard_pages()
    for name, page in pages.items():
        assert (ROOT / "docs" / name).read_text("utf-8") == page
    readme = (ROOT / "README.md").read_text("utf-8")
    for method in ("timeline", "timeline+gru", "naive+timeline", "backupdate+gru", "naive+gru"):
        lines = pages["leaderboard.md"].splitlines()
        row = next(line for line in lines if line.startswith(f"| {method} |"))
        (published,) = re.findall(rf"^\| \*{re.escape(method)}\* \|.*", readme, re.MULTILINE)
        assert {*re.findall(r"[\d.]+ \[[^]]+\]", published)} <= {
            *re.findall(r"[\d.]+ \[[^]]+\]", row)
        }


def test_the_citation_names_this_version():
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == damian.__version__
