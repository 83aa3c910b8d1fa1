"""The record of a run: what a resumed run keeps of its first part, and damaged records."""

import json
import shlex
import sys

import pytest

from damian.recipes.cli import command
from damian.runs.run_record import RECORD, new_record, read_record, timed, write_record


def record(command: str, config_dir: str | None = None) -> dict:
    return {**new_record(command, "cpu", 1, config_dir), "started": f"when {command} began"}


def test_a_resumed_run_keeps_its_first_command_and_its_configuration_files(tmp_path):
    write_record(tmp_path, record("first", str(tmp_path / "own")))
    with timed(tmp_path):
        pass
    write_record(tmp_path, record("second"))
    write_record(tmp_path, record("third"))
    stored = read_record(tmp_path)
    assert stored["command"] == "first"
    assert stored["started"] == "when first began"
    assert stored["config_dir"] == str(tmp_path / "own")
    assert [part["command"] for part in stored["resumed"]] == ["second", "third"]
    assert stored["resumed"][0]["started"] == "when second began"


@pytest.mark.parametrize(
    "text",
    ["[]", "{", "", "{}"],
)
def test_a_damaged_record_is_harmless(tmp_path, text):
    (tmp_path / RECORD).write_text(text)
    with timed(tmp_path):
        write_record(tmp_path, record("again"))
    stored = json.loads((tmp_path / RECORD).read_text())
    assert stored["command"] == "again"
    assert stored["wall_time_s"] >= 0


@pytest.mark.parametrize(
    ("program", "begin"),
    [("damian train", "damian train"), ("/x/bin/damian train", "damian train")],
)
def test_a_command_can_be_typed_again(monkeypatch, program, begin):
    monkeypatch.setattr(sys, "argv", [program])
    words = ["delay.obs={law: uniform}", "it's", "-m"]
    typed = command(words)
    assert typed.startswith(f"{begin} ")
    assert shlex.split(typed)[2:] == words
