"""Replay memory in checkpoints; that a loaded one goes on as it was: recipes/test_resume.py."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import ReplayBuffer

from damian.common.errors import InputError
from damian.replay.time_storage import TimeStorage
from damian.runs.checkpoint import plain
from damian.runs.replay_memory import ReplayMemory


def test_a_missing_file_is_refused_in_one_line(tmp_path):
    buffer, other = (ReplayBuffer(storage=TimeStorage(40)) for _ in range(2))
    buffer.extend(TensorDict({"time": torch.zeros(2, 20)}, [2, 20]))
    state = plain(ReplayMemory(buffer, tmp_path).state_dict())
    (tmp_path / "000002.pt").unlink()
    with pytest.raises(InputError, match=r"^resume: .*000002\.pt: it "):
        ReplayMemory(other, tmp_path).load_state_dict(state)
