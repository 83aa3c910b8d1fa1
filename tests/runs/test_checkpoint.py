"""Checkpoint files: whole or not there, refused in one line if they are damaged, and never executed."""

import hashlib
import io
import os
import re
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictParams
from torch import nn

from damian.common.atomic_files import remove_unfinished, write_atomically
from damian.common.errors import InputError, RunError
from damian.runs.checkpoint import read_checkpoint, restore, to_tensordict, write_checkpoint
from damian.runs.training_state import checkpoint_file, load_networks


@pytest.fixture
def file(tmp_path) -> Path:
    write_checkpoint(
        tmp_path / "checkpoint.pt", {"components": {}, "training": {"weights": torch.arange(99)}}
    )
    return tmp_path / "checkpoint.pt"


def test_everything_that_states_consist_of_is_read_as_it_was(tmp_path):
    whole = torch.arange(1000.0)
    step = TensorDict({"done": torch.zeros(2, 1, dtype=torch.bool)}, [2])
    step["agents"] = TensorDict({"x": whole[:6].view(2, 3)}, [2, 3])
    numbers = {
        "a": [1, 2.5, None, "text", True, float("nan")],
        "b": (np.float64(3.5), np.int64(4)),
        7: b"bytes",
    }
    module = nn.BatchNorm1d(3)
    content = {"step": step, **numbers, "module": module.state_dict(), "size": torch.Size([2])}
    write_checkpoint(tmp_path / "x.pt", content)
    assert (tmp_path / "x.pt").stat().st_size < 6000  # a view does not bring along what it was cut from
    read = read_checkpoint(tmp_path / "x.pt", "key")
    assert read["b"] == (3.5, 4)
    assert read["a"][:5] == numbers["a"][:5]
    assert read[7] == b"bytes"
    assert read["size"] == torch.Size([2])
    loaded = to_tensordict(read["step"])
    assert (loaded == step).all()
    assert loaded["agents"].batch_size == torch.Size([2, 3])
    nn.BatchNorm1d(3).load_state_dict(read["module"])


@pytest.mark.parametrize("value", [object(), {1, 2}, np.zeros(2), lambda: 0])
def test_what_a_checkpoint_cannot_store_is_refused_before_anything_is_written(file, value):
    before = file.read_bytes()
    with pytest.raises(InputError, match=r"checkpoint\.mine\[1\]: a checkpoint cannot store a"):
        write_checkpoint(file, {"mine": [0, value]})
    assert file.read_bytes() == before


def flipped(data: bytes, place: int) -> bytes:
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: b"", "it is empty"),
        (lambda data: data[:5], "it is cut or damaged"),
        (lambda data: data[:60], "it is cut or damaged"),
        (lambda data: data[:-1], "bytes after its first line instead of"),
        (lambda data: data[: len(data) // 2], "bytes after its first line instead of"),
        (lambda data: data + b"x", "bytes after its first line instead of"),
        (lambda data: flipped(data, len(data) // 2), "it is damaged: its SHA-256"),
        (lambda data: flipped(data, -2), "it is damaged: its SHA-256"),
        (lambda data: b"\x00" * 5000, "it is no checkpoint of damian"),
        (lambda data: data.split(b"\n", 1)[1], "it is no checkpoint of damian"),
        (lambda data: data.replace(b"checkpoint 2 ", b"checkpoint 3 ", 1), "in format 3, and damian"),
    ],
)
def test_a_damaged_file_is_refused_in_one_line_and_stays_as_it_is(file, damage, message):
    damaged = damage(file.read_bytes())
    file.write_bytes(damaged)
    with pytest.raises(InputError, match=re.escape(message)) as refused:
        load_networks(file.parent, "checkpoint", {})
    assert str(refused.value).startswith(f"checkpoint: {file}: ")
    assert "\n" not in str(refused.value)
    assert file.read_bytes() == damaged


class Payload:
    """Makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("nested", [False, True])
def test_a_file_that_would_run_code_is_refused(tmp_path, nested):
    buffer = io.BytesIO()
    torch.save({"components": Payload(tmp_path / "ran")} if nested else Payload(tmp_path / "ran"), buffer)
    data, digest = buffer.getvalue(), hashlib.sha256(buffer.getvalue()).hexdigest()
    file = tmp_path / "checkpoint.pt"
    file.write_bytes(f"damian checkpoint 2 0.4.0 {len(data)} {digest}\n".encode() + data)
    with pytest.raises(InputError, match="something else than tensors and numbers, and is not loaded"):
        read_checkpoint(file, "checkpoint")
    assert not (tmp_path / "ran").exists()


def test_the_folder_of_an_older_version_is_refused_without_reading_it(tmp_path):
    (tmp_path / "checkpoint").mkdir()
    (tmp_path / "checkpoint" / "other.pickle").write_bytes(b"cos\nsystem\n(S'touch ran'\ntR.")
    with pytest.raises(InputError, match=r"damian 0\.4 or an older one wrote its checkpoint"):
        checkpoint_file(tmp_path, "resume")
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint"]


@pytest.mark.parametrize("content", [{"weights": 1}, {"components": 3, "training": {}}])
def test_a_checkpoint_of_something_else_is_refused(tmp_path, content):
    write_checkpoint(tmp_path / "checkpoint.pt", content)
    with pytest.raises(InputError, match="is not the checkpoint of a training"):
        load_networks(tmp_path, "checkpoint", {})


def test_a_foreign_component_is_refused_in_one_line():
    stored = {"actor": nn.Linear(3, 4).state_dict()}
    for network, problem in ((nn.Linear(3, 5), "size mismatch for weight"), (nn.ReLU(), "Unexpected key")):
        with pytest.raises(InputError, match=problem) as refused:
            restore({"actor": network}, stored, Path("x.pt"), "checkpoint")
        assert str(refused.value).startswith("checkpoint: x.pt: its actor does not fit this run: ")
        assert "\n" not in str(refused.value)
    with pytest.raises(InputError, match=r"it has no critic, only actor: another learner wrote it"):
        restore({"critic": nn.ReLU()}, stored, Path("x.pt"), "checkpoint")


def test_weights_of_other_sizes_in_a_tensordict_are_refused_without_printing_it():
    weights, stored = (TensorDictParams(TensorDict({"weight": torch.zeros(size)})) for size in (3, 4))
    problem = "its critic does not fit this run: its networks have other sizes or layers"
    with pytest.raises(InputError, match=problem):
        restore({"critic": weights}, {"critic": stored.state_dict()}, Path("x.pt"), "checkpoint")


def test_a_segment_of_another_checkpoint_is_refused(file):
    with pytest.raises(InputError, match="it belongs to another checkpoint"):
        read_checkpoint(file, "resume", digest="0" * 64)


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_file_that_cannot_be_written_leaves_the_older_one_and_nothing_else(file, monkeypatch, call):
    before = file.read_bytes()

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, call, fail)
    with pytest.raises(RunError, match=r"checkpoint\.pt: it cannot be written: No space left on device"):
        write_checkpoint(file, {"other": OrderedDict()})
    assert file.read_bytes() == before
    assert [path.name for path in file.parent.iterdir()] == [file.name]


def test_what_a_killed_process_was_writing_is_removed(tmp_path):
    for name in ("checkpoint.pt.part", "run.json.part", "notes.txt"):
        (tmp_path / name).touch()
    remove_unfinished(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    write_atomically(tmp_path / "notes.txt", "ä")
    assert (tmp_path / "notes.txt").read_bytes() == "ä".encode()
