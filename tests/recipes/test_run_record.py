"""The record of a run: what a resumed run keeps of its first part, and its command."""

import shlex
import sys

import torch
import torchrl

from damian.recipes.cli import command
from damian.runs.run_record import read_record, timed, write_record


def test_a_resumed_run_keeps_the_record_of_its_first_part(tmp_path):
    write_record(tmp_path, "first", overrides=["agents=2"])
    with timed(tmp_path):
        pass
    for again in ("second", "third"):
        write_record(tmp_path, again, overrides=[])
    stored = read_record(tmp_path)
    assert (stored["command"], stored["overrides"]) == ("first", ["agents=2"])
    assert [part["command"] for part in stored["resumed"]] == ["second", "third"]


def test_versions_are_those_of_what_is_imported_whatever_the_distribution_is_called(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.metadata.Distribution.from_name", lambda name: 1 / 0)
    write_record(tmp_path, "first")
    packages = read_record(tmp_path)["packages"]
    assert (packages["torchrl"], packages["torch"]) == (torchrl.__version__, torch.__version__)


def test_a_command_can_be_typed_again(monkeypatch):
    words = ["delay.obs={law: uniform}", "it's", "-m"]
    monkeypatch.setattr(sys, "argv", ["/x/bin/damian train", *words])
    assert shlex.split(command()) == ["damian", "train", *words]
