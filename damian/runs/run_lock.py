"""A lock on a run folder, so that two runs never write into the same one."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows has no such locks
    fcntl = None

from damian.common.atomic_files import writing
from damian.common.errors import InputError


@contextmanager
def locked(folder: Path, key: str = "hydra.run.dir") -> Iterator[None]:
    """Lock a folder for what is done inside.

    The lock is on the open folder itself: it leaves no file, and ends with the process, however that ends.

    Args:
        folder: the run folder; without one there is nothing to lock.
        key: the setting that names the folder, for errors.

    Raises:
        InputError: another process has locked it.
    """
    if fcntl is None or not is_folder(folder):
        yield
        return
    with writing(folder):
        descriptor = os.open(folder, os.O_RDONLY)
    try:
        # The folder of a run that was refused may just have been removed by that run.
        if not _lock(descriptor) or not os.fstat(descriptor).st_nlink:
            raise InputError(
                f"{key}: {folder} is in use by another run: wait for its end, or choose another folder"
            )
        yield
    finally:
        os.close(descriptor)


def is_locked(folder: Path) -> bool:
    """Has another process, or another run of this one, locked the folder?"""
    try:
        with locked(folder):
            return False
    except InputError:
        return True


def is_folder(path: Path) -> bool:
    """Is the path a folder? False for what can be no path at all, such as one of 5000 characters."""
    try:
        return path.is_dir()
    except OSError:
        return False


def _lock(descriptor: int) -> bool:
    """Lock an open folder; False if another process has. Some file systems cannot lock: there it is true."""
    assert fcntl is not None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True
