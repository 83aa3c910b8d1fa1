"""The documents keep their word: their Python runs, their commands exist, their links lead somewhere."""

import dataclasses
import re
import runpy
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import damian
import damian.transforms
from damian import Constant
from damian.delays.laws import LAWS
from damian.delays.line import DelayLine
from damian.delays.samplers import Sampler
from damian.recipes.cli import settings
from damian.recipes.command import PROGRAMS, SETTINGS
from damian.recipes.known import check_words, known_settings
from damian.replay.hindsight import MessageLog, latest_arrived
from damian.server.features import GLOBAL, LOCAL
from damian.show.episode import COLUMNS

ROOT = Path(damian.__file__).parents[1]
DOCUMENTS = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "RESULTS.md", "CHANGELOG.md")]
DOCUMENTS += sorted((ROOT / "docs").glob("*.md"))
FILES = [file for file in DOCUMENTS if file.name != "CHANGELOG.md"]  # which names commands of older versions
FILES += [*(ROOT / "conf").rglob("*.yaml"), *(ROOT / "examples").rglob("*.py")]
FILES += sorted((ROOT / "recipes").glob("*.py"))
NEVER = 9
"""A delay that ends after the documents' example."""


def test_the_readmes_python_runs(capsys):
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    exec(block.replace("num_worlds=1024", "num_worlds=4"), {})
    reward, age = map(float, capsys.readouterr().out.replace("tensor(", "").replace(")", "").split())
    assert 0 <= reward <= 1
    assert 3 < age < 8


def commands(file: Path) -> Iterator[tuple[str, list[str]]]:
    """The commands that a file names: program and words."""
    text = file.read_text().replace("\\\n", "")
    for line in re.findall(r"(?:^[ #]*|`)damian ([a-z]+ [^`\n|]*)", text, re.MULTILINE):
        command = re.split(r"  +[#(]", line)[0]  # an explanation stands behind some spaces
        name, *words = shlex.split(command, comments=True)
        yield name, words


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_every_command_that_a_file_names_exists(file):
    for name, words in commands(file):
        line = shlex.join([name, *words])
        assert name in PROGRAMS, line
        own = [word for word in words if re.match(r"[\w.]+=", word) and not re.search("FOLDER|NAME", word)]
        if name in SETTINGS and not any(word.startswith(("--help", "--config-dir")) for word in words):
            check_words(SETTINGS[name], own)


def test_every_comparison_that_a_file_names_has_its_tasks_delays_and_arms():
    found = [words for file in FILES for name, words in commands(file) if name == "compare"]
    found = [
        words for words in found if any(word.split("=")[0] in ("tasks", "delays", "arms") for word in words)
    ]
    assert len(found) > 2
    for words in found:
        settings(*[word for word in words if "hydra" not in word], program="compare")


@pytest.mark.parametrize("file", DOCUMENTS, ids=lambda file: file.name)
def test_every_file_that_a_document_links_to_exists(file):
    links = re.findall(r"\]\(([^)#:]+)\)|src=\"([^\"]+)\"", file.read_text())
    assert all((file.parent / (link or image)).exists() for link, image in links)


def test_the_citation_names_this_version():
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == damian.__version__


def test_the_table_of_an_episodes_columns_says_what_files_say():
    rows = re.findall(r"\| `(\w+)` \| ([^|]*) \| ([^|]*) \|", (ROOT / "docs" / "episodes.md").read_text())
    assert [name for name, _, _ in rows] == list(COLUMNS)
    for name, meaning, shape in rows:
        assert re.sub(r"\W", "", meaning + shape) == re.sub(r"\W", "", COLUMNS[name]), name


def test_the_delay_models_table_is_what_the_delay_line_and_back_updating_do():
    text = (ROOT / "docs" / "concepts.md").read_text()
    rows = re.search(r"\| step \| 0 .*?\n\n", text, re.DOTALL)[0].strip().splitlines()
    cells = {row.split("|")[1].strip(): [c.strip() for c in row.split("|")[2:-1]] for row in rows}
    delays = [NEVER if d == "lost" else int(d) for d in cells["its delay [steps]"][1:]]
    held, age = hold_messages(delays)
    assert [f"m{m}" for m in held] == cells["the server holds"]
    assert [str(a) for a in age] == cells["age of information [steps]"]
    sent = torch.arange(1, 8).float().view(7, 1, 1)  # steps 1 to 7: the last message arrives at step 7
    log = MessageLog(
        sent,
        torch.tensor([*delays, 0]).view(7, 1).masked_fill(torch.tensor([*delays, 0]).view(7, 1) == NEVER, -1),
        torch.tensor([*held[1:], 7]).float().view(7, 1, 1),
        torch.tensor([*age[1:], 0]).view(7, 1),
    )
    known = [f"m{int(m)}" for m in latest_arrived(log)[0].flatten()[:6]]
    assert known == cells["back-updated at step 7"][1:]


def test_the_table_of_delay_laws_has_every_parameter_and_its_default():
    text = (ROOT / "docs" / "concepts.md").read_text()
    table = re.search(r"\| law \| parameters .*?\n\n", text, re.DOTALL)[0]
    rows, laws = dict(re.findall(r"^\| `(\w+)`[^|]*\| ([^|]*) \|", table, re.MULTILINE)), dict(LAWS.items())
    assert {*rows} == {*laws}
    for law, cell in rows.items():
        written = dict(re.findall(r"`(\w+)`(?: \[[^]]*\])?(?: \(([^)]*)\))?", cell))
        fields = dataclasses.fields(laws[law])
        assert [*written] == [field.name for field in fields]
        for field in fields:
            if type(field.default) in (int, float):
                assert float(written[field.name]) == field.default, (law, field.name)


def test_the_documents_name_every_feature_every_transform_and_every_file_of_their_folders():
    readme, docs = (ROOT / "README.md").read_text(), ROOT / "docs"
    concepts, delays = ((docs / name).read_text() for name in ("concepts.md", "transforms.md"))
    assert [name for name in (*LOCAL, *GLOBAL) if f"`{name}`" not in concepts] == []
    said = known_settings("train")["observation.global_features"].text
    assert [name for name in GLOBAL if name not in said] == []
    others = {"StatefulTransform", "check_order", "delay_trajectories"}
    assert [name for name in {*damian.transforms.__all__} - others if f"`{name}`" not in delays] == []
    files = [*docs.glob("*.md"), *(ROOT / "examples").glob("*.py")]
    assert [file.name for file in files if file.name not in readme] == []


def test_the_figure_of_the_delay_model_shows_what_back_updating_knows():
    figures = runpy.run_path(str(ROOT / "docs" / "figures.py"))
    assert figures["age_in_hindsight"](np.array([3, 1, 0, -1, 2, 0])).tolist() == [0, 0, 0, 1, 0, 0]
    drawn = figures["draw_messages"](Constant(3), 6, seed=0)
    assert drawn.delay.tolist() == [3] * 6
    assert drawn.age.tolist() == [1, 2, 3, 3, 3, 3]


def hold_messages(delays: list[int]) -> tuple[list[int], list[int]]:
    """Numbers and ages of the messages that a receiver holds, if message 0 is there from the start."""

    class Listed(Sampler):
        def forward(self, streams, clock, memory, context=None):
            return torch.tensor([delays[int(clock) - 1]]), memory

    line = DelayLine(Listed([[1 / NEVER] * NEVER]), "generation")
    memory = line.init_memory([torch.zeros(1)], torch.zeros(1, dtype=torch.long))
    held, age = [0], [0]
    for number in range(1, len(delays) + 1):
        memory, delivery = line.step(memory, [torch.tensor([float(number)])], None)
        held.append(int(delivery.held[0]))
        age.append(int(delivery.age))
    return held, age
