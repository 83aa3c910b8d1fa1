"""Replay memory in checkpoints: what is loaded equals what was there, whenever it was stored."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import ReplayBuffer

from damian.common.errors import InputError
from damian.replay.time_storage import TimeStorage
from damian.runs.checkpoint import plain
from damian.runs.replay_memory import ReplayMemory

WORLDS = 2
ROWS = 20
LONGEST = 3


def make_buffer():
    storage = TimeStorage(WORLDS * ROWS)
    storage.longest = LONGEST  # as a BackupdateStorage: later messages correct so many rows
    return ReplayBuffer(storage=storage)


def batch(begin, n_rows):
    time = torch.arange(begin, begin + n_rows).expand(WORLDS, -1)
    agents = TensorDict({"x": torch.stack([time, time], -1)}, [WORLDS, n_rows, 2])
    return TensorDict({"time": time.clone(), "agents": agents}, [WORLDS, n_rows])


@pytest.mark.parametrize("sizes", [[1, 2, 3], [5] * 9, [3, 20, 20, 20, 2]])
@pytest.mark.parametrize("every", [1, 3])
def test_a_loaded_memory_equals_the_stored_one(tmp_path, sizes, every):
    buffer = make_buffer()
    n_rows = 0
    memory = ReplayMemory(buffer, tmp_path / "replay")
    files = {}
    for i, size in enumerate(sizes):
        if n_rows:  # late messages change the latest rows
            steps = buffer.storage.steps
            steps["time"][buffer.storage.latest(min(LONGEST, n_rows))] += 1000
        buffer.extend(batch(n_rows, size))
        n_rows += size
        if i % every == 0 or i == len(sizes) - 1:
            state = plain(memory.state_dict())
            memory.remove_old()
            found = {path: path.read_bytes() for path in (tmp_path / "replay").glob("*")}
            assert all(
                files.get(path, data) == data for path, data in found.items()
            )  # each is written once
            assert len(found) <= ROWS
            files |= found
            other = make_buffer()
            ReplayMemory(other, tmp_path / "replay").load_state_dict(state)
            held = buffer.storage.n_steps
            assert other.storage.n_steps == held
            assert (buffer.storage.steps[:held] == other.storage.steps[:held]).all()
            assert buffer.storage.latest().equal(other.storage.latest())
            assert buffer.writer.state_dict() == other.writer.state_dict()
            assert other.storage.steps["agents"].batch_size == (ROWS, WORLDS, 2)
            more = batch(n_rows, 2)
            other.extend(more)
            assert other.storage.steps["time"][other.storage.latest(2)].equal(more["time"].T)


def test_a_missing_file_is_refused_in_one_line(tmp_path):
    buffer = make_buffer()
    buffer.extend(batch(0, 20))
    state = plain(ReplayMemory(buffer, tmp_path / "replay").state_dict())
    (tmp_path / "replay" / "000002.pt").unlink()
    with pytest.raises(InputError, match=r"^resume: .*replay/000002\.pt: it "):
        ReplayMemory(make_buffer(), tmp_path / "replay").load_state_dict(state)
