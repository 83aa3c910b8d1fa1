"""Every command that README and docs show runs, in the order in which it is shown, with tiny
numbers (slow).

The commands of a document run one after the other in a folder with a trained run and the files that
they name.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import ring

import damian

ROOT = Path(damian.__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PROGRAM = [sys.executable, "-W", "ignore", "-c", "from damian.recipes.command import main; main()"]
TINY = [
    "frames=64",
    "worlds=8",
    "learner.steps=8",
    "eval_episodes=2",
    "model.hidden=[8]",
    "logger=csv",
    "region.lattice_step=60",
    "episode.max_steps=12",
]
OF_RUNS = f"overrides={json.dumps([word for word in TINY if word != 'logger=csv'])}".replace(
    '"', "'"
)
FLIGHTS = ["eval_episodes=3"]
SHORTER = {
    "train": TINY,
    "evaluate": FLIGHTS,
    "fly": [*FLIGHTS, "episode.max_steps=12"],
    "compare": ["seeds=1", "processes=1", OF_RUNS],
}
"""Settings that make the commands of a program short; they replace those of the document."""
INSTEAD = {
    "seed=0,1,2": "seed=0",
    "experiment=delays": "experiment=usecases",
    "hydra/launcher=submitit_slurm": "hydra/launcher=submitit_local",
    "hydra.launcher.partition=cpu": "hydra.launcher.timeout_min=60",
    "region.path=map.kml": "region.path=park.geojson",
    "region.where=[name:north,name:south]": "region.where=name:park",
}
"""What stands instead of some words: fewer runs, a map that is there, and no Slurm."""
PARK = ring(-4.134, 52.808, -4.122, 52.817)


def commands(text):
    """The words of the commands in the blocks of a document, without ``damian``."""
    blocks = re.findall(r"^```\w*\n(.*?)^```", text.replace("\\\n", ""), re.DOTALL | re.MULTILINE)
    lines = [line.removeprefix("$ ") for block in blocks for line in block.splitlines()]
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("damian ")]


def shortened(words):
    """A command with tiny numbers."""
    words = [INSTEAD.get(word, word) for word in words]
    if any(word.startswith("resume=") for word in words):
        return [re.sub(r"^frames=.*", "frames=128", word) for word in words]
    if any(word.startswith("replay=") for word in words):  # nothing is flown
        return words
    shorter = SHORTER.get(words[0], [])
    if any(word.startswith("checkpoint=") for word in words):  # the region is that of the training
        shorter = [word for word in shorter if not word.startswith("episode.")]
    replaced = {word.split("=")[0] for word in shorter}
    return [word for word in words if word.split("=")[0] not in replaced] + shorter


COMMANDS = {file.name: commands(file.read_text()) for file in DOCUMENTS}
COMMANDS = {name: found for name, found in COMMANDS.items() if found}


def call(words, folder):
    """Run a command in a folder; returns what it prints."""
    done = subprocess.run(
        [*PROGRAM, *words],
        cwd=folder,
        env=os.environ
        | {"PYTHONPATH": str(ROOT)},  # as in a clone, whose examples the documents name
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, (words, done.stderr[-2000:])
    return done.stdout


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A trained run and the files that the documents name."""
    folder = tmp_path_factory.mktemp("documents")
    call(["train", *TINY, "hydra.run.dir=runs/FOLDER"], folder)
    for name in "AB":
        shutil.copytree(folder / "runs" / "FOLDER", folder / "runs" / name)
    flight = [
        "fly",
        "policy=random",
        "formats=[]",
        "episode.max_steps=12",
        "region.lattice_step=60",
    ]
    call([*flight, "hydra.run.dir=undelayed"], folder)
    call([*flight, "delay.obs=3", "hydra.run.dir=late"], folder)
    shutil.copy(folder / "late" / "episode_0.json", folder / "runs" / "FOLDER")
    shape = {"type": "Polygon", "coordinates": [PARK]}
    park = {"type": "Feature", "properties": {"name": "park"}, "geometry": shape}
    (folder / "park.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": [park]})
    )
    for file in (ROOT / "examples" / "extending").glob("*.py"):
        shutil.copy(file, folder)
    return folder


def write_journal(path):
    """A journal of two UAVs, each of whose reports comes in up to a second late."""
    lines = [
        {
            "journal": "damian-advice",
            "version": 3,
            "fleet": "north",
            "uavs": ["A", "B"],
        }
    ]
    for n in range(60):
        row = {
            "ID": "AB"[n % 2],
            "time": 1000.0 + n,
            "lat": 52.811,
            "lon": -4.128,
            "sequence": n // 2,
        }
        lines.append({"received": 1000.0 + n + 0.1 * (n % 10), "reports": [row]})
    path.parent.mkdir(exist_ok=True)
    path.write_text("".join(json.dumps(line) + "\n" for line in lines), "utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_the_commands_of_a_document_run(name, trained, tmp_path):
    folder = tmp_path / "folder"
    shutil.copytree(trained, folder)
    for words in map(shortened, COMMANDS[name]):
        if any("journals/" in word for word in words):
            write_journal(folder / "journals" / "north.jsonl")
        call(words, folder)
