"""A lock on a run folder, so that two runs never write into the same one."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from damian.common.atomic_files import writing
from damian.common.errors import InputError
from damian.runs.run_folder import check_no_links

LOCK = ".lock"
"""The file that is locked; a process that was killed leaves it in the folder, where it does no harm."""


@contextmanager
def locked(folder: Path, key: str = "hydra.run.dir") -> Iterator[None]:
    """Lock a folder for what is done inside; the lock ends with the process, however that ends."""
    if not folder.is_dir():
        yield
        return
    check_no_links(folder, key)
    lock = FileLock(folder / LOCK, blocking=False, thread_local=False)
    with writing(folder):
        try:
            lock.acquire()
        except Timeout:
            problem = "is in use by another run: wait for its end, or choose another folder"
            raise InputError(f"{key}: {folder} {problem}") from None
    try:
        yield
    finally:
        # While the lock is held: who opened this file before sees that it is gone, and makes a new one.
        with suppress(OSError):  # Windows cannot delete an open file
            (folder / LOCK).unlink()
        lock.release()
