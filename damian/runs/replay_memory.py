"""Replay memory in checkpoints: steps that stay as they are go into files of their own, each written once."""

from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer

from damian.common.atomic_files import remove_unfinished, writing
from damian.replay.time_storage import TimeStorage
from damian.runs.checkpoint import read_checkpoint, to_tensordict, write_checkpoint

SEGMENT_BYTES = 2**21
"""A segment has at least so many bytes; fewer are stored in the checkpoint itself."""
SEGMENTS = 32
"""A full replay memory has about so many segments at most."""


class ReplayMemory:
    """The steps of a replay buffer, as a component of a checkpoint, which costs as much as the new steps.

    Row k is step k of all worlds since the beginning of the training. Segment s has the rows from s R up to
    (s + 1) R, and is written when late messages cannot change them any more; later rows are in the state.
    """

    def __init__(self, buffer: ReplayBuffer | None, folder: Path) -> None:
        self._buffer, self._folder = buffer, folder
        self._segments: list[int] = []
        """Numbers of the segments that the latest state needs."""

    @property
    def _storage(self) -> TimeStorage:
        return cast(TimeStorage, cast(ReplayBuffer, self._buffer).storage)

    def state_dict(self) -> dict[str, Any]:
        """Write the segments that are complete by now, and return what else there is to store."""
        if self._buffer is None or not self._buffer.write_count:
            return {"written": 0}
        storage, written = self._storage, cast(int, self._buffer.write_count)
        oldest, per_segment = written - len(storage.latest()), self._rows_per_segment()
        # Late messages correct rows after these (``BackupdateStorage``).
        final = written - cast(int, getattr(storage, "longest", -1)) - 1
        segments = range(oldest // per_segment, max(final // per_segment, oldest // per_segment))
        for segment in segments:
            if segment not in self._segments:
                self._write(segment, max(oldest, segment * per_segment), segment * per_segment + per_segment)
        self._segments = list(segments)
        return {
            "written": written,
            "oldest": oldest,
            "segments": self._segments,
            "rows": self._rows(max(oldest, segments.stop * per_segment), written),
            "writer": self._buffer.writer.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Fill the empty buffer with the rows of a state and of its segments."""
        if self._buffer is None or not state["written"]:
            return
        parts = [read_checkpoint(self._path(segment), "resume")["rows"] for segment in state["segments"]]
        rows = torch.cat([to_tensordict(part) for part in (*parts, state["rows"])])  # type: ignore[arg-type]
        rows = cast(TensorDictBase, rows)[state["oldest"] - state["written"] :]
        storage = self._storage
        if storage.device != "auto":
            rows = rows.to(storage.device)
        most_rows = -(-storage.max_size // rows.shape[1])
        index = torch.arange(state["oldest"], state["written"]) % most_rows
        # Not ``storage.set``: a BackupdateStorage has corrected these rows already.
        LazyTensorStorage.set(storage, index, rows)  # type: ignore[arg-type]
        self._buffer.writer.load_state_dict(state["writer"])
        self._segments = list(state["segments"])

    def remove_old(self) -> None:
        """Delete the segments that the latest state does not need."""
        remove_unfinished(self._folder)
        needed = {self._path(segment) for segment in self._segments}
        for path in sorted({*self._folder.glob("*.pt")} - needed):
            path.unlink()

    def _rows_per_segment(self) -> int:
        steps = self._storage.steps
        per_row = sum(steps.get(key)[0].nbytes for key in steps.keys(True, True))
        return max(-(-len(steps) // SEGMENTS), -(-SEGMENT_BYTES // per_row))

    def _rows(self, begin: int, end: int) -> TensorDictBase:
        steps = self._storage.steps
        return cast(TensorDictBase, steps[torch.arange(begin, end) % len(steps)])

    def _write(self, segment: int, begin: int, end: int) -> None:
        with writing(self._folder):
            self._folder.mkdir(exist_ok=True)
        write_checkpoint(self._path(segment), {"rows": self._rows(begin, end)})

    def _path(self, segment: int) -> Path:
        return self._folder / f"{segment:06}.pt"
