"""Removes the folders of runs that were refused; only what Hydra or the run itself has made."""

import re
import traceback
from collections.abc import Sequence
from pathlib import Path

from damian.common.errors import InputError
from damian.runs.metrics_log import EVENTS
from damian.runs.run_folder import CHECKPOINT, CONFIG
from damian.runs.run_lock import LOCK, is_empty, is_folder, is_locked
from damian.runs.run_record import RECORD
from damian.runs.training_state import stored_progress

SWEEP = "multirun.yaml"
"""File that Hydra writes into the folder of a sweep."""

_older: set[Path] = set()
"""Folders that existed before Hydra began."""


def remember_folders(words: Sequence[str]) -> None:
    """Remember which of the folders that the words of a command line name exist already; these stay."""
    named = [word.partition("=")[2].strip("'\"") for word in words if re.match(r"hydra\.\w+\.dir=", word)]
    paths = [Path(name).absolute() for name in (".", "runs", "multirun", *named)]
    _older.clear()
    _older.update(each for path in paths for each in (path, *path.parents) if is_folder(each))


def drop_unused(folder: Path) -> None:
    """Remove a run folder with nothing in it but what is written before the first update."""
    files = [path for path in folder.iterdir() if path.name != LOCK] if is_folder(folder) else []
    written_first = all(path.name in (CONFIG, RECORD, CHECKPOINT) or _is_events(path) for path in files)
    if written_first and not _has_learnt(folder):
        for path in files:
            path.unlink()
        drop_empty(folder)


def drop_empty(folder: Path) -> None:
    """Remove an empty run folder that no other run uses, and the folders that Hydra made around it."""
    if not is_folder(folder) or not is_empty(folder) or is_locked(folder):
        return
    (folder / LOCK).unlink(missing_ok=True)
    folder.rmdir()
    parent = folder.parent
    drop_sweep(parent)
    # Without a command line nothing tells which of the folders above were there before.
    while _older and is_folder(parent) and parent.absolute() not in _older and not any(parent.iterdir()):
        parent.rmdir()
        parent = parent.parent


def drop_sweep(folder: Path) -> None:
    """Remove the folder of a sweep of which no run is left."""
    if is_folder(folder) and [path.name for path in folder.iterdir()] == [SWEEP]:
        (folder / SWEEP).unlink()
        drop_empty(folder)


def sweep_folder(error: Exception) -> Path | None:
    """The folder that Hydra made for a sweep that it then refused; only Hydra's frame knows its name."""
    frames = (frame for frame, _ in traceback.walk_tb(error.__traceback__))
    return next((frame.f_locals["sweep_dir"] for frame in frames if "sweep_dir" in frame.f_locals), None)


def _has_learnt(folder: Path) -> bool:
    try:
        return stored_progress(folder)["progress"]["updates"] > 0
    except InputError:
        return (folder / CHECKPOINT).exists()


def _is_events(path: Path) -> bool:
    return path.name.startswith(EVENTS)
