"""The record of a run: with which versions, on which machine and for how long it was made."""

import json
import os
import platform
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import damian
from damian.common.atomic_files import write_atomically
from damian.common.errors import InputError

RECORD = "run.json"
OF_FIRST_PART = ("command", "started")
"""Entries of ``new_record`` that the list ``resumed`` repeats each time that a run is resumed."""
POLICY = "policy_sha256"
"""Entry of a run that begins with a stored policy: the SHA-256 of its checkpoint."""
PACKAGES = ("torch", "torchrl", "tensordict", "gymnasium", "hydra-core", "numpy", "shapely")
"""Packages whose versions a record names."""


def new_record(command: str, device: str, threads: int, config_dir: str | None) -> dict[str, Any]:
    """What is known when a run begins.

    Args:
        command: the command line, to be run again in a shell.
        device: name of the device of all tensors.
        threads: number of torch's threads.
        config_dir: folder with configuration files of the user's own, if there is one.
    """
    return {
        "command": command,
        "config_dir": config_dir and str(Path(config_dir).resolve()),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "damian": damian.__version__,
        "commit": commit(),
        "python": platform.python_version(),
        "packages": {name: version(name) for name in PACKAGES},
        "machine": {
            "system": platform.platform(),
            "processor": processor(),
            "cores": os.cpu_count(),
            "threads": threads,
            "device": device,
        },
    }


def commit() -> str | None:
    """The commit of DAMIAN's source if it is a git checkout, with ``+changes`` if files were changed."""
    folder = Path(damian.__file__).parents[1]
    if not (folder / ".git").exists():
        return None
    git = ["git", "-C", str(folder), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+changes"]
    try:
        return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def processor() -> str:
    """The name of the processor."""
    cpus = Path("/proc/cpuinfo")
    lines = cpus.read_text().splitlines() if cpus.exists() else []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor())


def write_record(folder: Path, record: dict[str, Any]) -> None:
    """Write the record into a run folder.

    A resumed run keeps the command, the configuration files and the wall time of its first part; the list
    ``resumed`` gets the command and the time of each further part.
    """
    first = read_record(folder)
    if first:
        part = {name: record[name] for name in OF_FIRST_PART}
        record |= {name: first[name] for name in (*OF_FIRST_PART, "config_dir", POLICY) if first.get(name)}
        record["resumed"] = [*first.get("resumed", []), part]
    _write(folder, {**record, "wall_time_s": first.get("wall_time_s", 0.0)})


@contextmanager
def timed(folder: Path) -> Iterator[None]:
    """Add the wall time of what is done inside to the record of the run folder, however it ends."""
    begin = time.monotonic()
    try:
        yield
    finally:
        if record := read_record(folder):
            seconds = record["wall_time_s"] + time.monotonic() - begin
            _write(folder, {**record, "wall_time_s": round(seconds, 1)})


def read_record(folder: Path) -> dict[str, Any]:
    """The record of a run; empty if there is none that can be read."""
    try:
        record = json.loads((folder / RECORD).read_text())
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) and "damian" in record else {}


def check_version(folder: Path, key: str) -> None:
    """Check that this minor version of damian has written a run folder, as its record says.

    Files change between minor versions, and no version reads those of another one.

    Args:
        folder: the run folder.
        key: the setting that names it, for errors.

    Raises:
        InputError: another minor version has written it.
    """
    writer = str(read_record(folder).get("damian", damian.__version__))
    if writer.split(".")[:2] != damian.__version__.split(".")[:2]:
        here = f"this is damian {damian.__version__}"
        raise InputError(
            f"{key}: {folder}: damian {writer} wrote it, and {here}: train again, or use {writer}"
        )


def _write(folder: Path, record: dict[str, Any]) -> None:
    write_atomically(folder / RECORD, json.dumps(record, indent=2) + "\n")
