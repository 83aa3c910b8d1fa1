"""Fleets and their journals: what is written, what is restored, and what is taken back."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from reporting import START
from test_fleet import LLANBEDR, SEEN, TASKS, scenario_of

from damian.advice.clocks import LIFE
from damian.advice.desk import Desk
from damian.advice.fleet import Fleet
from damian.advice.journal import Journal
from damian.advice.node import Node, for_uavs
from damian.advice.tables import checked_rows
from damian.baselines.greedy import greedy_policy
from damian.common.errors import InputError, RunError
from damian.learners.mappo import MappoConfig
from damian.learners.networks import ModelConfig
from damian.learners.recurrent import add_recurrent_state
from damian.world.landing import ActionConfig

UAVS = ["A", "B"]
WORDS = ["region=llanbedr", "clock.simulation=1s", "delay.obs=0", "delay.obs={law: lag, steps: 2}"]
ABOUT = {"policy": "greedy", "checkpoint": None, "overrides": WORDS}
OTHER_ACTIONS = ActionConfig(distances=[0.0, 30.0, 60.0, 90.0])


@pytest.fixture(scope="module")
def node() -> Node:
    return Node(for_uavs(scenario_of(region=LLANBEDR), 2))


@pytest.fixture
def make_desk(node, tmp_path):
    """Makes a desk whose journals lie in a folder; every desk is closed in the end."""
    made: list[Desk] = []

    def make(node: Node = node, policy=None, folder: Path = tmp_path / "journals", **about) -> Desk:
        policy = policy or greedy_policy(node.env)
        made.append(Desk(lambda uavs: Fleet(node, uavs, policy), folder, {**ABOUT, **about}))
        return made[-1]

    yield make
    for desk in made:
        desk.close()


def report(desk: Desk, uav: str, time: float, point: int = 0, now: float | None = None, **more) -> list[str]:
    lat, lon = desk.fleet("north").ground.place(point)
    rows = checked_rows([("row 1", {"ID": uav, "time": time, "lat": lat, "lon": lon, **more})])
    return desk.report("north", rows, time if now is None else now)


def begun(desk: Desk) -> Desk:
    """The desk with a fleet that has begun."""
    desk.create("north", desk.check_new("north", list(UAVS)))
    for i, uav in enumerate(UAVS):
        report(desk, uav, START, 40 * i)
    return desk


def lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "journals" / "north.jsonl").read_text().splitlines()]


def told(desk: Desk) -> list[list]:
    return [list(each) for each in desk.fleet("north").told]


# Two services.


def test_journals_are_of_one_desk_until_it_is_closed(make_desk):
    first = begun(make_desk())
    with pytest.raises(InputError, match=r"journal: .*journals is in use by another run"):
        make_desk()
    first.close()
    first.close()
    assert [*make_desk().fleets] == ["north"]


def test_the_journals_of_a_killed_service_can_be_used(make_desk, tmp_path):
    code = "import sys, time, pathlib; from damian.advice.desk import Desk\n"
    code += "held = Desk(None, pathlib.Path(sys.argv[1])); print('held', flush=True); time.sleep(600)"
    words = [sys.executable, "-W", "ignore", "-c", code, str(tmp_path / "journals")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "held\n"
            with pytest.raises(InputError, match="is in use by another run"):
                make_desk()
        finally:
            process.send_signal(signal.SIGKILL)
    assert begun(make_desk()).fleets


def test_a_folder_that_stays_empty_is_removed_and_a_refused_one_is_free_again(make_desk, tmp_path):
    make_desk().close()
    assert not (tmp_path / "journals").exists()
    begun(make_desk()).close()
    before = len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0
    for _ in range(3):
        with pytest.raises(InputError, match="it is of"):
            make_desk(policy_of="x", checkpoint="elsewhere")
    if before:
        assert len(os.listdir("/proc/self/fd")) == before, "no file stays open"
    assert [*make_desk().fleets] == ["north"]


def test_a_copy_of_a_journal_does_not_take_its_fleet_over(make_desk, tmp_path):
    begun(make_desk()).close()
    copy = tmp_path / "journals" / "copy.jsonl"
    copy.write_bytes((tmp_path / "journals" / "north.jsonl").read_bytes())
    with pytest.raises(
        InputError, match=r"copy\.jsonl: it is the journal of the fleet north, or a copy of it"
    ):
        make_desk()
    copy.unlink()
    assert [*make_desk().fleets] == ["north"]


# Other settings.


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["clock.simulation=2s", *WORDS[2:]],
            "region: llanbedr then, not given now; clock.simulation: 1s then, 2s",
        ),
        (
            [*WORDS, "actions.distances=[0,60]"],
            "actions.distances: not given then, [0,60] now: give the same, or",
        ),
        (
            [*WORDS[:3], "delay.obs={law: lag, steps: 3}"],
            "delay.obs: {law: lag, steps: 2} then, {law: lag, steps: 3}",
        ),
    ],
)
def test_a_journal_of_other_settings_is_refused_with_both_values(make_desk, words, message):
    begun(make_desk()).close()
    with pytest.raises(InputError) as error:
        make_desk(overrides=words)
    assert f"north.jsonl: it is of other settings: {message}" in str(error.value)


def test_what_is_free_may_change_with_a_restart(make_desk):
    begun(make_desk(overrides=[*WORDS, "port=0", "+token=one"])).close()
    now = ["port=8000", "host=0.0.0.0", "journal=x", "durable=true", "device=cuda", "agents=7"]
    desk = make_desk(overrides=["+region=llanbedr", *now, *WORDS[1:]])
    assert [*desk.fleets] == ["north"]


@pytest.mark.parametrize(
    "changed",
    [
        {"actions": OTHER_ACTIONS},
        {"region": LLANBEDR.__class__(**{**vars(LLANBEDR), "lattice_step": 60.0})},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_a_journal_that_sends_uavs_elsewhere_than_it_says_is_refused(make_desk, changed):
    """The words are the same, but a file that they name has changed."""
    desk = begun(make_desk())
    desk.advise("north", START + 1)
    assert any(each[-1].goal != each[-1].origin for each in told(desk))
    desk.close()
    other = Node(for_uavs(scenario_of(**{"region": LLANBEDR, **changed}), 2))
    with pytest.raises(
        InputError, match=r"north\.jsonl: line 4: it is damaged, or of another region, lattice or"
    ):
        make_desk(other)


def test_advice_that_says_no_place_is_damaged(make_desk, tmp_path):
    desk = begun(make_desk())
    desk.advise("north", START + 1)
    desk.close()
    path = tmp_path / "journals" / "north.jsonl"
    path.write_text(path.read_text().replace('"ID":"B"', '"ID":"C"'))
    with pytest.raises(
        InputError, match=r"line 3: ID: 'C' is no UAV|line 4: it is damaged: .* where B was sent"
    ):
        make_desk()


# A journal that cannot be written.


def failing(monkeypatch, desk: Desk):
    def fail(entry):
        raise RunError("north.jsonl: it cannot be written: No space left on device")

    monkeypatch.setattr(desk._journals["north"], "append", fail)


def recurrent(env):
    actor = MappoConfig().make_actor(env, ModelConfig(hidden=[8], rnn="gru"))
    add_recurrent_state(env, actor)
    return actor


@pytest.mark.parametrize("policy_of", [greedy_policy, recurrent])
def test_nobody_is_told_what_the_journal_does_not_say(make_desk, monkeypatch, tmp_path, policy_of):
    """On a full disk a question changes nothing: when there is room again, all goes on as after a restart."""
    scenario = scenario_of(region=LLANBEDR, observation=SEEN, delay=TASKS["late"]["delay"])
    node = Node(for_uavs(scenario, 2))
    policy = policy_of(node.env)
    desk = begun(make_desk(node, policy))
    first = desk.advise("north", START + 1, ["A"])
    with monkeypatch.context() as full:
        failing(full, desk)
        for _ in range(2):
            with pytest.raises(RunError, match="No space left"):
                desk.advise("north", START + 1.5)
        with pytest.raises(RunError, match="No space left"):
            report(desk, "B", START + 1.2, 3)
        with pytest.raises(RunError, match="No space left"):
            desk.advise("north", START + 3)
    assert [len(each) for each in told(desk)] == [1, 0]
    assert len(lines(tmp_path)) == 4
    states = [row["state"] for row in desk.advise("north", START + 4, [])]
    assert states == ["bound", "none"], "as the UAVs know it"
    assert report(desk, "B", START + 4.5, 3) == ["new"], "the first one was not taken"
    desk.advise("north", START + 5)
    now = desk.fleet("north")
    desk.close()
    again = make_desk(node, policy).fleet("north")
    assert [list(each) for each in again.told] == [list(each) for each in now.told]
    assert [len(each) for each in again.told] == [2, 1]
    assert first[0]["ID"] == "A"
    for fleet in (now, again):
        fleet.advance(START + 9)
    if now.hidden is not None:
        assert again.hidden is not None
        assert now.hidden.equal(again.hidden)


def test_a_fleet_whose_journal_cannot_be_begun_is_not_there(make_desk, monkeypatch, tmp_path):
    desk = make_desk()

    def fail(self, entry):
        raise RunError("the disk is full")

    with monkeypatch.context() as full:
        full.setattr(Journal, "append", fail)
        with pytest.raises(RunError):
            desk.create("north", list(UAVS))
    assert not desk.fleets
    begun(desk).close()
    assert [*make_desk().fleets] == ["north"]


def test_a_fleet_whose_journal_cannot_be_renamed_goes_on(make_desk, monkeypatch, tmp_path):
    desk = begun(make_desk())

    def fail(*_):
        raise OSError(13, "Permission denied")

    with monkeypatch.context() as broken:
        broken.setattr(Path, "rename", fail)
        with pytest.raises(RunError, match=r"north\.jsonl: .*Permission denied"):
            desk.end("north", START + 1)
    assert report(desk, "A", START + 2, 1) == ["new"]
    assert len(lines(tmp_path)) == 4
    desk.end("north", START + 3)
    assert not desk.fleets
    assert [path.suffix for path in (tmp_path / "journals").iterdir()] == [".ended"]


# Clocks.


def test_what_is_accepted_can_be_restored_after_the_clock_was_wrong(make_desk):
    """The clock of the service goes ahead for a moment, farther than a fleet lasts."""
    desk = begun(make_desk())
    desk.advance(START + LIFE + 10)
    with pytest.raises(InputError, match=r"row 1: time: the fleet began more than 1e\+06 s ago"):
        report(desk, "A", START + 1, now=START + 1)
    with pytest.raises(InputError, match=r"time: the fleet began more than 1e\+06 s ago"):
        desk.advise("north", START + 1)
    desk.close()
    assert [*make_desk().fleets] == ["north"]


def test_a_clock_that_was_ahead_before_the_fleet_began_does_no_harm(make_desk):
    desk = make_desk()
    desk.create("north", list(UAVS))
    desk.advance(START + 7200)
    for i, uav in enumerate(UAVS):
        assert report(desk, uav, START, 40 * i) == ["new"]
    with pytest.raises(InputError, match=r"row 1: time: 1700000100 s is 100\.0 s after it came in"):
        report(desk, "A", START + 100, now=START)
    desk.close()
    assert make_desk().fleet("north").start == START


def test_an_unset_clock_does_not_begin_a_fleet(make_desk):
    desk = make_desk()
    desk.create("north", list(UAVS))
    with pytest.raises(InputError, match=r"row 1: time: 12 s is 1699999988\.0 s before it came in"):
        report(desk, "A", 12.0, now=START)
    begun(desk)
    assert [row["state"] for row in desk.advise("north", START + 1)] == ["fly", "fly"]
