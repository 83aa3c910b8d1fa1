"""Journals: whole lines or none, whatever stops the process."""

import errno
import os

import pytest

from damian.advice import journal as module
from damian.advice.desk import Desk
from damian.advice.journal import Journal, entries, head, reports_of
from damian.common.errors import InputError, RunError

HEAD = head("north", ["A"], {"policy": "greedy"})
LINE = {"received": 1.5, "reports": [{"id": "A", "time": 1.0, "lat": 53.1, "lon": -4.5}]}


@pytest.mark.parametrize("durable", [False, True])
def test_what_is_appended_is_there_at_once(tmp_path, durable):
    written = Journal(tmp_path / "folder" / "x.jsonl", durable)
    for entry in (HEAD, LINE, LINE):
        written.append(entry)
    assert list(entries(written.path)) == [HEAD, LINE, LINE]
    written.close()
    assert written.path.stat().st_mode & 0o077 == 0, "others need not read where UAVs are"


def test_an_unfinished_line_is_removed_before_the_next_one_is_written(tmp_path):
    path = tmp_path / "x.jsonl"
    Journal(path).append(HEAD)
    with path.open("a") as file:
        file.write('{"received": 1.5, "repo')
    assert list(entries(path)) == [HEAD]
    Journal(path).append(LINE)
    assert list(entries(path)) == [HEAD, LINE]


def test_a_full_disk_leaves_no_part_of_a_line(tmp_path, monkeypatch):
    written, write = Journal(tmp_path / "x.jsonl"), os.write
    written.append(HEAD)
    monkeypatch.setattr(module.os, "write", lambda file, line: write(file, line[:10]))
    with pytest.raises(RunError, match="the disk is full"):
        written.append(LINE)

    def fail(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(module.os, "write", fail)
    with pytest.raises(RunError, match="No space left on device"):
        written.append(LINE)
    monkeypatch.setattr(module.os, "write", write)
    assert list(entries(written.path)) == [HEAD]
    written.append(LINE)
    assert list(entries(written.path)) == [HEAD, LINE]


@pytest.mark.parametrize("cut_fails", [False, True])
def test_a_line_that_does_not_last_is_not_kept(tmp_path, monkeypatch, cut_fails):
    """The disk fails when it is told to keep a line; perhaps even when the line is removed again."""
    written = Journal(tmp_path / "x.jsonl", durable=True)
    written.append(HEAD)

    def fail(*_):
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as broken:
        broken.setattr(module.os, "fsync", fail)
        if cut_fails:
            broken.setattr(module.os, "ftruncate", fail)
        with pytest.raises(RunError, match="Input/output error"):
            written.append(LINE)
    assert len(list(entries(written.path))) == 1 + cut_fails
    written.append({"asked": 2.0, "told": {}})
    assert list(entries(written.path)) == [HEAD, {"asked": 2.0, "told": {}}]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["nonsense"], "line 1: it is damaged"),
        (["[]"], "line 1: it is no object"),
        (
            ['{"journal": "damian-advice", "version": 2}'],
            "line 1: it is no journal of damian advise of version 1",
        ),
        (
            ['{"journal": "damian-advice", "version": 1, "fleet": "x", "about": {"policy": "mode"}}'],
            "it is of {",
        ),
        (
            ['{"journal": "damian-advice", "version": 1, "fleet": "../x", "uavs": ["A"]}'],
            "fleet: '../x' is not",
        ),
        (['{"journal": "damian-advice", "version": 1, "fleet": "x", "uavs": 3}'], "uavs: 3 is not a list"),
        (['{"journal": "damian-advice", "version": 1, "uavs": ["A"]}'], "line 1: it is damaged: the name of"),
        (
            ['{"journal": "damian-advice", "version": 1, "fleet": "y", "uavs": ["A"]}'],
            "it is the journal of the fleet y, or a copy of it: name it y.jsonl, or move it",
        ),
        (
            ['{"journal": "damian-advice", "version": 1, "fleet": "x", "about": {"overrides": 3}}'],
            "it is damaged: overrides: 3 is not a list of settings",
        ),
    ],
)
def test_a_damaged_journal_is_named_and_nothing_of_it_used(tmp_path, lines, message):
    (tmp_path / "x.jsonl").write_text("\n".join([*lines, ""]))
    with pytest.raises(InputError) as error:
        Desk(lambda uavs: pytest.fail("no fleet is needed"), tmp_path)
    assert str(error.value).startswith(f"{tmp_path / 'x.jsonl'}: {message}")


@pytest.mark.parametrize("time", ["NaN", "Infinity", "1e999", "-1e999", "1e10", "true", "1" + "0" * 400])
@pytest.mark.parametrize("name", ["received", "asked"])
def test_a_time_that_is_none_is_named_with_its_line(tmp_path, name, time):
    path = tmp_path / "x.jsonl"
    Journal(path).append(HEAD)
    with path.open("a") as file:
        file.write(f'{{"{name}": {time}, "reports": [], "told": {{}}}}\n')
    with pytest.raises(InputError, match=r"x\.jsonl: line 2: it is damaged: "):
        list(entries(path))


def test_a_time_of_receipt_that_is_no_number_is_refused():
    for received in (float("nan"), float("inf"), None, "1", True):
        with pytest.raises(InputError, match="no time at which they came in"):
            reports_of({"received": received, "reports": LINE["reports"]})


def test_a_journal_that_was_never_begun_is_removed(tmp_path):
    (tmp_path / "x.jsonl").write_text('{"journal": "dam')
    assert not Desk(lambda uavs: pytest.fail("no fleet is needed"), tmp_path).fleets
    assert not list(tmp_path.iterdir())
