"""Replay memory in checkpoints: steps that stay as they are go into files of their own, each
written once."""

from pathlib import Path
from typing import cast

import torch
from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer

from damian.common.atomic_files import make_folder, remove_unfinished
from damian.replay.time_storage import TimeStorage
from damian.runs.checkpoint import Stored, read_checkpoint, to_tensordict, write_checkpoint

FILES = 32
"""A full replay memory has about so many files."""


class ReplayMemory:
    """The steps of a replay buffer, as a component of a checkpoint, which costs as much as the new
    steps.

    Row k is step k of all worlds since the beginning of the training. File f has the rows from f R
    up to (f + 1) R, and is written when late messages cannot change them any more; later rows are
    in the state.
    """

    def __init__(self, buffer: ReplayBuffer | None, folder: Path) -> None:
        self._buffer = buffer
        self._folder = folder
        self._files: list[int] = []
        """Numbers of the files that the latest state needs."""

    @property
    def _storage(self) -> TimeStorage:
        return cast(TimeStorage, cast(ReplayBuffer, self._buffer).storage)

    def state_dict(self) -> Stored:
        """Write the files that are complete by now, and return what else there is to store."""
        if self._buffer is None or not self._buffer.write_count:
            return {"written": 0}
        storage = self._storage
        written = self._buffer.write_count
        oldest = written - len(storage.latest())
        per_file = -(-len(storage.steps) // FILES)
        # Late messages correct rows after these (``BackupdateStorage``).
        final = written - getattr(storage, "longest", -1) - 1
        files = range(oldest // per_file, max(final // per_file, oldest // per_file))
        for file in {*files} - {*self._files}:
            make_folder(self._folder)
            rows = self._rows(max(oldest, file * per_file), (file + 1) * per_file)
            write_checkpoint(self._path(file), {"rows": rows})
        self._files = list(files)
        return {
            "written": written,
            "oldest": oldest,
            "files": self._files,
            "rows": self._rows(max(oldest, files.stop * per_file), written),
            "writer": self._buffer.writer.state_dict(),
        }

    def load_state_dict(self, state: Stored) -> None:
        """Fill the empty buffer with the rows of a state and of its files."""
        if self._buffer is None or not state["written"]:
            return
        parts = [read_checkpoint(self._path(file), "resume")["rows"] for file in state["files"]]
        rows = torch.cat([to_tensordict(part) for part in (*parts, state["rows"])])  # type: ignore[arg-type]
        rows = rows[state["oldest"] - state["written"] :]
        storage = self._storage
        if storage.device != "auto":
            rows = rows.to(storage.device)
        index = torch.arange(state["oldest"], state["written"]) % -(
            -storage.max_size // rows.shape[1]
        )
        # Not ``storage.set``: a BackupdateStorage has corrected these rows already.
        LazyTensorStorage.set(storage, index, rows)  # type: ignore[arg-type]
        self._buffer.writer.load_state_dict(state["writer"])
        self._files = list(state["files"])

    def remove_old(self) -> None:
        """Delete the files that the latest state does not need."""
        remove_unfinished(self._folder)
        for path in {*self._folder.glob("*.pt")} - {*map(self._path, self._files)}:
            path.unlink()

    def _rows(self, begin: int, end: int) -> TensorDictBase:
        steps = self._storage.steps
        return steps[torch.arange(begin, end) % len(steps)]

    def _path(self, file: int) -> Path:
        return self._folder / f"{file:06}.pt"
