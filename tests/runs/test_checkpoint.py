"""Checkpoint files: whole or not there, refused in one line if they are damaged, and never
executed."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn

from damian.common.errors import InputError
from damian.runs.checkpoint import read_checkpoint, restore, to_tensordict, write_checkpoint
from damian.runs.training_state import load_networks


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "checkpoint.pt"
    write_checkpoint(path, {"components": {}, "training": {"weights": torch.arange(99)}})
    return path


def test_everything_that_states_consist_of_is_read_as_it_was(tmp_path):
    whole = torch.arange(1000.0)
    step = TensorDict({"done": torch.zeros(2, 1, dtype=torch.bool)}, [2])
    step["agents"] = TensorDict({"x": whole[:6].view(2, 3)}, [2, 3])
    numbers = {
        "a": [1, 2.5, None, "text", True],
        "b": (np.float64(3.5), np.int64(4)),
        7: b"bytes",
    }
    module = nn.BatchNorm1d(3)
    content = {
        "step": step,
        **numbers,
        "module": module.state_dict(),
        "size": torch.Size([2]),
    }
    write_checkpoint(tmp_path / "x.pt", content)
    assert (
        tmp_path / "x.pt"
    ).stat().st_size < 6000  # a view does not bring along what it was cut from
    read = read_checkpoint(tmp_path / "x.pt", "key")
    assert {name: read[name] for name in numbers} == numbers
    assert read["size"] == torch.Size([2])
    loaded = to_tensordict(read["step"])
    assert (loaded == step).all()
    assert loaded["agents"].batch_size == torch.Size([2, 3])
    nn.BatchNorm1d(3).load_state_dict(read["module"])


def test_what_a_checkpoint_cannot_store_is_refused_before_anything_is_written(file):
    before = file.read_bytes()
    with pytest.raises(InputError, match="cannot be stored"):
        write_checkpoint(file, {"mine": [0, object()]})
    assert file.read_bytes() == before


def flipped(data):
    """With one bit of a weight changed, which the file's checksum tells."""
    place = data.index(torch.arange(99).numpy().tobytes()[:80]) + 50
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]


@pytest.mark.parametrize("damage", [lambda data: b"", lambda data: data[: len(data) // 2], flipped])
def test_a_damaged_file_is_refused_in_one_line_and_stays_as_it_is(file, damage):
    damaged = damage(file.read_bytes())
    file.write_bytes(damaged)
    with pytest.raises(InputError, match=r"^checkpoint: .*checkpoint\.pt: it is damaged.*$"):
        load_networks(file.parent, "checkpoint", {})
    assert file.read_bytes() == damaged


class Payload:
    """Makes a folder when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_a_file_that_would_run_code_is_refused(tmp_path):
    torch.save({"components": Payload(tmp_path / "ran")}, tmp_path / "checkpoint.pt")
    with pytest.raises(InputError, match="no checkpoint of a training"):
        read_checkpoint(tmp_path / "checkpoint.pt", "checkpoint")
    assert not (tmp_path / "ran").exists()


def test_a_component_that_does_not_fit_is_refused_in_one_line():
    stored = {"actor": nn.Linear(3, 4).state_dict()}
    with pytest.raises(
        InputError, match=r"^checkpoint: x\.pt: its actor does not fit .*size mismatch.*$"
    ):
        restore({"actor": nn.Linear(3, 5)}, stored, Path("x.pt"), "checkpoint")
    with pytest.raises(InputError, match="it has no critic, only actor"):
        restore({"critic": nn.ReLU()}, stored, Path("x.pt"), "checkpoint")
