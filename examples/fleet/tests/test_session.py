"""Fleets and their journals: what is written, what is restored, and what is refused."""

import os
from pathlib import Path

import pytest
from reporting import FREE, START, read_json
from test_fleet import LLANBEDR, SEEN, TASKS, scenario_of
from test_round_trip import recurrent

from damian.baselines.script import script_policy
from damian.common.errors import InputError, RunError
from damian.field.node import Node, for_uavs
from damian_fleet import journal as module
from damian_fleet.fleet import Fleet
from damian_fleet.journal import About, Advised, Head, Journal, Received, read_head, read_lines
from damian_fleet.session import AdviceSession

UAVS = ["A", "B"]
WORDS = ["region=llanbedr", "clock.simulation=1s", "delay.obs=0", "delay.obs={law: lag, steps: 2}"]
ABOUT = {"policy": "script", "checkpoint": None, "overrides": WORDS}
HEAD = Head(fleet="north", uavs=["A"], about=About(policy="script"))
LINE = Received(received=1.5, reports=[{"id": "A", "time": 1.0, "lat": 53.1, "lon": -4.5}])


@pytest.fixture(scope="module")
def node() -> Node:
    return Node(for_uavs(scenario_of(region=LLANBEDR), 2))


@pytest.fixture
def make_session(node, tmp_path):
    """Makes a session whose journals lie in a folder; every session is closed in the end."""
    made: list[AdviceSession] = []

    def make(node: Node = node, policy=None, **about) -> AdviceSession:
        policy = policy or script_policy(node.env)
        folder = tmp_path / "journals"
        made.append(
            AdviceSession(
                lambda uavs, mark: Fleet(node, uavs, policy, rules=FREE, mark=mark),
                folder,
                {**ABOUT, **about},
            )
        )
        return made[-1]

    yield make
    for session in made:
        session.close()


def report(
    session: AdviceSession, uav: str, time: float, point: int = 0, now: float | None = None
) -> list[str]:
    lat, lon = session.fleet("north").ground.place(point)
    rows = read_json({"ID": uav, "time": time, "lat": lat, "lon": lon})
    return session.report("north", rows, time if now is None else now)


def begun(session: AdviceSession) -> AdviceSession:
    """The session with a fleet that has begun."""
    session.create("north", UAVS)
    for i, uav in enumerate(UAVS):
        report(session, uav, START, 40 * i)
    return session


def told(session: AdviceSession) -> list[list]:
    return [list(each) for each in session.fleet("north").told]


# Journals as files.


def lines_of(path: Path) -> list:
    return [read_head(path), *(line for _, line in read_lines(path))]


def test_what_is_appended_is_there_at_once_and_an_unfinished_line_is_removed(tmp_path):
    path = tmp_path / "folder" / "x.jsonl"
    written = Journal(path)
    for line in (HEAD, LINE):
        written.append(line)
    assert lines_of(path) == [HEAD, LINE]
    assert path.stat().st_mode & 0o077 == 0, "others need not read where UAVs are"
    with path.open("a") as file:
        file.write('{"received": 1.5, "repo')
    assert lines_of(path) == [HEAD, LINE]
    Journal(path).append(LINE)
    assert lines_of(path) == [HEAD, LINE, LINE]


def test_a_line_that_cannot_be_written_is_not_kept(tmp_path, monkeypatch):
    written, write = Journal(tmp_path / "x.jsonl"), os.write
    written.append(HEAD)
    with monkeypatch.context() as full:
        full.setattr(module.os, "write", lambda file, line: write(file, line[:10]))
        with pytest.raises(RunError, match="the disk is full"):
            written.append(LINE)
    later = Advised(asked=2.0, told={})
    written.append(later)
    assert lines_of(written.path) == [HEAD, later]


GOOD = '{"journal": "damian-advice", "version": 3, "fleet": "x", "uavs": ["A"], "about": {}}\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nonsense\n", "it is not JSON"),
        (GOOD.replace("3", "2"), "line 1: version: 2: Input should be 3"),
        (GOOD, "it is of other landing points"),
    ],
)
def test_a_journal_of_something_else_is_refused(node, tmp_path, text, message):
    (tmp_path / "x.jsonl").write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as error:
        AdviceSession(lambda uavs, mark: Fleet(node, uavs, lambda _: pytest.fail("it was asked")), tmp_path)
    assert str(error.value).startswith(f"{tmp_path / 'x.jsonl'}: {message}")


# Two services.


def test_journals_are_of_one_session_until_it_is_closed(make_session):
    session = begun(make_session())
    with pytest.raises(InputError, match=r"journal: .*journals is in use by another run"):
        make_session()
    session.close()
    assert make_session().names == ["north"]


# Other settings.


def test_a_journal_of_other_settings_is_refused_with_both_values(make_session):
    begun(make_session()).close()
    with pytest.raises(InputError) as error:
        make_session(overrides=["clock.simulation=2s", *WORDS[2:]])
    message = "region: llanbedr then, not given now; clock.simulation: 1s then, 2s"
    assert f"north.jsonl: it is of other settings: {message}" in str(error.value)
    now = ["port=8000", "host=0.0.0.0", "journal=x", "device=cuda", "agents=7"]
    session = make_session(overrides=["+region=llanbedr", *now, *WORDS[1:]])
    assert session.names == ["north"], "these may differ"


# A journal that cannot be written.


def fail(*_):
    raise RunError("north.jsonl: it cannot be written: No space left on device")


@pytest.mark.parametrize("policy_of", [script_policy, recurrent])
def test_nobody_is_told_what_the_journal_does_not_say(make_session, monkeypatch, tmp_path, policy_of):
    """On a full disk a question changes nothing: when there is room again, all goes on as after a restart."""
    scenario = scenario_of(region=LLANBEDR, observation=SEEN, delay=TASKS["late"]["delay"])
    node = Node(for_uavs(scenario, 2))
    policy = policy_of(node.env)
    session = begun(make_session(node, policy))
    session.advise("north", START + 1, ["A"])
    with monkeypatch.context() as full:
        full.setattr(session._journals["north"], "append", fail)
        for now in (START + 1.5, START + 1.5, START + 3):
            with pytest.raises(RunError, match="No space left"):
                session.advise("north", now)
        with pytest.raises(RunError, match="No space left"):
            report(session, "B", START + 3.2, 3)
    assert [len(each) for each in told(session)] == [1, 0]
    assert len(lines_of(tmp_path / "journals" / "north.jsonl")) == 4
    states = [row.state for row in session.advise("north", START + 4, [])]
    assert states == ["bound", "none"], "as the UAVs know it"
    assert report(session, "B", START + 4.5, 3) == ["new"], "the first one was not taken"
    session.advise("north", START + 5)
    now = session.fleet("north")
    session.close()
    again = make_session(node, policy).fleet("north")
    assert [list(each) for each in again.told] == [list(each) for each in now.told]
    assert [len(each) for each in again.told] == [2, 1]
    for fleet in (now, again):
        fleet.advance(START + 9)
    if now.hidden is not None:
        assert again.hidden is not None
        assert now.hidden.equal(again.hidden)
