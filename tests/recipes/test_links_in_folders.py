"""Each program, started where one of the things that it writes is a link: what the link leads to
stays.

What a program writes is found out by a run without links: each path that Python writes, if only for
a while.
"""

import os
import shutil
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from helpers import SMALLEST_TRAINING
from stopped_runs import SAC

from damian.common.errors import InputError
from damian.recipes.command import main

TINY = SMALLEST_TRAINING
OFF_POLICY = [word for word in TINY if "minibatches" not in word] + SAC
HERE = "hydra.run.dir=named"
COMPARE = ["compare", "--config-dir=conf", "experiment=x", "seeds=1", HERE, f"overrides={TINY}"]
EXPERIMENT = "{tasks: {t: [agents=2]}, methods: {undelayed: {delayed: false}}}"
TABLE = "ID,source time,lat,lon\nA,NA,52.8110,-4.1283\n"
LOG = "\n".join(["ID,time,receive time", *(f"A,{i},{i + 0.5}" for i in range(20)), ""])
FILMS = ["formats=[gif,png,html]"]
DOORS = {
    "train": (None, ["train", *TINY, HERE]),
    "off-policy": (None, ["train", *OFF_POLICY, "logger=csv", HERE]),
    "resume": ("off-policy", ["train", "resume=named", "frames=96"]),
    "evaluate": (None, ["evaluate", "checkpoint=finished/train", HERE]),
    "fly": (None, ["fly", "policy=random", "episode.max_steps=2", "eval_episodes=1", *FILMS, HERE]),
    "advise": (
        None,
        ["advise", "policy=script", "region.lattice_step=90", "table=table.csv", HERE],
    ),
    "fit": (None, ["advise", "fit=log.csv", HERE]),
    "export": ("train", ["export", "named"]),
    "sweep": (None, ["train", "-m", *TINY, "seed=0", "hydra.sweep.dir=named"]),
    "results": ("sweep", ["results", "named"]),
    "compare": (None, COMPARE),
    "report": ("compare", [*COMPARE, "report_only=true"]),
}
"""Ways to write in ``named``: whose finished folder each begins with, or none, and its words."""

_written = None
"""The paths that are written, made or removed while it is a set."""


def _listen(event, arguments):
    writes = event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    if _written is not None and (writes or event in ("os.mkdir", "os.rename", "os.remove")):
        paths = [each for each in arguments[:2] if isinstance(each, str | bytes | os.PathLike)]
        _written.update(map(os.path.abspath, map(os.fsdecode, paths)))


sys.addaudithook(_listen)  # none can be removed


def contents(folder):
    """All below a folder, with the times of the last changes, since the same may be written
    again."""
    return {
        str(path.relative_to(folder)): (
            b"" if path.is_dir() else path.read_bytes(),
            path.stat().st_mtime_ns,
        )
        for path in sorted(folder.rglob("*"))
    }


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with what the programs read, and with the finished folder of each door that was
    asked for."""
    folder = tmp_path_factory.mktemp("links")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "argv", [])
        Path("conf/experiment").mkdir(parents=True)
        Path("conf/experiment/x.yaml").write_text(EXPERIMENT, "utf-8")
        Path("table.csv").write_text(TABLE, "utf-8")
        Path("log.csv").write_text(LOG, "utf-8")
        yield folder


def begin(state):
    """The folder ``named`` as it is in a state; empty, and not there, without one."""
    named = Path("named")
    shutil.rmtree(named, ignore_errors=True)
    if state:
        shutil.copytree(state, named)
    return named


def finished(door):
    """A door's folder after a run without links, and what was written below it."""
    global _written  # noqa: PLW0603
    kept = Path("finished", door)
    told = Path("finished", f"{door}.txt")
    if not kept.exists():
        before, words = DOORS[door]
        if "checkpoint=finished/train" in words:
            finished("train")
        named = begin(finished(before)[0] if before else None).absolute()
        _written = set()
        main(words)
        below = [path for path in map(Path, sorted(_written)) if named in path.parents]
        _written = None
        shutil.copytree(named, kept)
        told.write_text("\n".join(str(path.relative_to(named)) for path in below), "utf-8")
    return kept, told.read_text("utf-8").splitlines()


def link(path, original, outside, dangling):
    """Put a link where a path was, or shall be, to a copy of the original outside, or to nothing
    there."""
    shutil.rmtree(outside, ignore_errors=True)
    outside.mkdir()
    if original.is_dir() and not dangling:
        shutil.copytree(original, outside / "target")
    elif not dangling:
        (outside / "target").write_bytes(original.read_bytes() if original.exists() else b"mine")
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(outside / "target")


CASES = [
    pytest.param("report", 3),
    *(pytest.param(door, 1, marks=pytest.mark.slow) for door in DOORS),
]


@pytest.mark.parametrize(("door", "share"), CASES)
def test_nothing_is_changed_through_a_link(place, door, share):
    whole, written = finished(door)
    before, words = DOORS[door]
    assert written
    for number, path in enumerate(written[::share]):
        for state in [finished(before)[0]] if before else [None, whole]:
            link(begin(state) / path, whole / path, place / "outside", dangling=number % 3 == 2)
            held = contents(place / "outside")
            with suppress(SystemExit, InputError):
                main(words)
            assert contents(place / "outside") == held, (path, state)
