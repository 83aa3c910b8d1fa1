"""The record of a run: with which versions, on which machine and for how long it was made."""

import json
import os
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from subprocess import DEVNULL, CalledProcessError, check_output
from typing import Any

import damian
from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError

RECORD = "run.json"
PACKAGES = ("torch", "torchrl", "tensordict", "gymnasium", "hydra", "numpy", "shapely")
"""Modules whose versions a record names: a nightly build is a distribution of another name."""


def write_record(folder: Path, command: str, resumes: bool, **entries: Any) -> None:
    """Write the record of a run that begins; that of a resumed one gets the command in its
    ``resumed``."""
    record = {"command": command, "started": datetime.now(UTC).isoformat(timespec="seconds")}
    if resumes and (first := read_record(folder)):
        record = {**first, "resumed": [*first.get("resumed", []), record]}
    else:
        record |= {
            "damian": damian.__version__,
            "commit": commit(),
            "python": platform.python_version(),
            "packages": {name: str(import_module(name).__version__) for name in PACKAGES},
            "machine": {"system": platform.platform(), "cores": os.cpu_count()},
            **entries,
            "wall_time_s": 0.0,
        }
    write_atomically(folder / RECORD, json.dumps(record, indent=2) + "\n")


def commit() -> str | None:
    """The commit of DAMIAN's source if it is a git checkout, with ``+changes`` if files were
    changed."""
    folder = Path(damian.__file__).parents[1]
    if not (folder / ".git").exists():
        return None
    git = ["git", "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+changes"]
    try:
        return check_output(git, cwd=folder, stderr=DEVNULL, encoding="utf-8").strip()
    except (OSError, CalledProcessError):
        return None


@contextmanager
def timed(folder: Path) -> Iterator[None]:
    """Add the wall time of what is done inside to the record of the run folder, however it ends."""
    begin = time.monotonic()
    try:
        yield
    finally:
        if record := read_record(folder):
            record["wall_time_s"] = round(record["wall_time_s"] + time.monotonic() - begin, 1)
            write_atomically(folder / RECORD, json.dumps(record, indent=2) + "\n")


def read_record(folder: Path) -> dict[str, Any]:
    """The record of a run; empty if there is none that can be read."""
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) and "damian" in record else {}


def check_version(folder: Path, key: str) -> None:
    """Check that this minor version of damian wrote a run folder; no version reads files of another
    one."""
    writer = str(read_record(folder).get("damian", damian.__version__))
    if writer.split(".")[:2] != damian.__version__.split(".")[:2]:
        problem = f"damian {writer} wrote it, and this is damian {damian.__version__}"
        raise InputError(f"{key}: {folder}: {problem}: train again, or use {writer}")
