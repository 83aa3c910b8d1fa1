"""Several fleets with their journals: what all sources of reports (tables, HTTP) have in common.

Each request checks, writes the line of the journal, and then changes the fleet: nothing is acknowledged that
the journal does not say, and a request that fails changes nothing.
"""

import io
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch

import damian
from damian import keys
from damian.common.atomic_files import UNFINISHED, writing
from damian.common.errors import InputError, RunError, described
from damian.common.text_files import named, show
from damian.field.rows import Report, Rows, validated
from damian.runs.run_folder import locked
from damian_fleet.answers import Acknowledgement, Advice
from damian_fleet.fleet import Fleet
from damian_fleet.journal import (
    SUFFIX,
    About,
    Acknowledged,
    Advised,
    Change,
    Command,
    Commanded,
    Head,
    Journal,
    Line,
    Members,
    Received,
    read_head,
    read_lines,
)
from damian_fleet.known import UavLog, mark_of, stored_report
from damian_fleet.orders import Decision
from damian_fleet.rules import FieldRules

MAY_DIFFER = {
    *("port", "host", "token", "journal"),
    *("policy", "checkpoint", "agents", "device", "frames", "episodes", "eval_episodes", "hydra"),
    *("reserve", "oldest_report", "clearance", "instant"),
}
"""Settings that a journal and a service need not share: those that say how reports come in and where journals
lie, those that are compared apart, and those on which no advice depends."""


SNAPSHOT = ".snapshot"
"""End of the name of the file with what a fleet knows, beside its journal."""
SNAPSHOT_LINES, SNAPSHOT_PERIOD, SNAPSHOT_TIME = 50, 30.0, 0.1
"""Lines of a journal and time [s] after which a fleet is stored anew; time for this in each round [s]."""
STORED = [Decision, UavLog, stored_report]
"""Of what snapshots are made, beside tensors and plain values; nothing else is read from them."""
_LOG = logging.getLogger("damian_fleet")


class NoFleet(InputError):
    """There is no fleet of this name."""


class AdviceSession:
    """The fleets of a service.

    The ``folder`` of journals is locked until ``close``, and the fleets in it are restored if they are of the
    policy and settings ``about``; with None nothing is kept. ``make_fleet`` makes a fleet of UAVs and the
    mark of its answers.
    """

    def __init__(
        self,
        make_fleet: Callable[[list[str], str], Fleet],
        folder: Path | None = None,
        about: Mapping[str, Any] | None = None,
    ) -> None:
        self.make, self._folder = make_fleet, folder
        self.about = About.model_validate(about or {})
        self.fleets: dict[str, Fleet] = {}
        """Those that are at hand; another one of ``names`` is restored when it is needed."""
        self.problem: str | None = None
        """Why a journal could not be written at last; None if it could."""
        self._journals: dict[str, Journal] = {}
        self._unreadable: set[str] = set()
        """Fleets that could not be restored."""
        self._unsaved: dict[str, int] = {}
        """Lines of journals since the latest snapshots."""
        self._saved: dict[str, float] = {}
        """When these were made [s]."""
        self._at_close = ExitStack()
        if folder is None:
            return
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        self._at_close.enter_context(locked(folder, "journal"))
        try:
            for path in sorted(folder.glob(f"*{SUFFIX}")):
                self._find(path)
        except BaseException:
            self.close()
            raise

    @property
    def names(self) -> list[str]:
        """The names of all fleets."""
        return sorted({*self.fleets, *self._journals})

    @property
    def latest(self) -> float:
        """The latest time that a journal names [s]."""
        return max((journal.last_time() for journal in self._journals.values()), default=0.0)

    def fleet(self, name: str) -> Fleet:
        """The fleet of a name."""
        if name not in self.fleets:
            if name not in self._journals:
                raise NoFleet(f"fleet: there is no fleet {show(name)}")
            try:
                self.fleets[name] = self._restored(self._journals[name])
            except InputError as error:  # its journal is damaged: the request is not wrong
                self._unreadable.add(name)
                raise RunError(str(error)) from None
        return self.fleets[name]

    def create(self, name: str, uavs: Any) -> bool:
        """Create a fleet of UAVs with these IDs; returns whether it is new."""
        head = validated(Head, {"fleet": name, "uavs": uavs, "about": self.about})
        if name in self.names:
            if self.fleet(name).uavs != head.uavs:
                raise InputError(f"fleet: {name} has other UAVs; end it first, or take another name")
            return False
        made = self.make(head.uavs, head.mark)
        if self._folder is not None:
            journal = Journal(self._folder / f"{name}{SUFFIX}")
            journal.append(head.model_copy(update={"ground": mark_of(made.ground), "rules": rules_of(made)}))
            self._journals[name] = journal
        self.fleets[name] = made
        return True

    def end(self, name: str, now: float) -> None:
        """End a fleet; its journal stays, under another name."""
        if name not in self.names:
            raise NoFleet(f"fleet: there is no fleet {show(name)}")
        if journal := self._journals.get(name):
            with writing(journal.path):
                journal.path.rename(journal.path.with_suffix(f".{now:.3f}.ended"))
                journal.path.with_suffix(SNAPSHOT).unlink(missing_ok=True)
            del self._journals[name]
        self.fleets.pop(name, None)
        self._unsaved.pop(name, None)

    def report(self, name: str, rows: Rows, now: float, file: bool = False) -> list[str]:
        """Take reports, all or none, and write them to the journal; returns what ``Fleet.report`` found."""
        fleet = self.fleet(name)
        clock = now if file else max(now, fleet.clock)
        for where, report in rows:
            with named(where):
                report.stamp(now, file)
                (report.model_extra or {}).clear()  # what is not understood need not be kept
                if not file:  # by the clock of the fleet, which never goes back
                    report.received = clock
                fleet.check(report, None if file else clock)
        reports = [report for _, report in rows]
        self._write(name, Received.model_construct(received=clock, reports=reports))
        return _taken(fleet, reports)

    def advise(
        self, name: str, now: float, asking: Sequence[str] | None = None, only: bool = False
    ) -> list[Advice]:
        """Let the UAVs that ask (all, if None) choose; what all, or ``only`` those, were told last."""
        fleet = self.fleet(name)
        choice = fleet.choose(now, asking)
        if choice is not None:
            told = {
                fleet.uavs[uav]: (each.kind, each.reason) if each.action is None else each.action
                for uav, each in choice.decisions.items()
            }
            advice = [fleet.advice_of(uav, each, each.kind) for uav, each in choice.decisions.items()]
            self._write(name, Advised.model_construct(asked=fleet.clock, told=told, advice=advice))
            fleet.tell(choice)
        return fleet.advice(fleet.numbers_of(asking) if only else None)

    def acknowledge(self, name: str, rows: list[Acknowledgement], now: float) -> list[str]:
        """Take acknowledgements, all or none; returns how far the answers have come, or ``unknown``."""
        fleet, clock = self.fleet(name), max(now, self.fleet(name).clock)
        fleet.advance(clock)
        for row in rows:
            fleet.number_of(row.id)
            (row.model_extra or {}).clear()
        outdated = [i for i, row in enumerate(rows) if fleet.start is not None and fleet.outdated(row)]
        line = Acknowledged.model_construct(received=clock, acknowledged=rows, outdated=outdated)
        self._write(name, line)
        return _acknowledged(fleet, line)

    def command(self, name: str, command: Command, now: float) -> list[str]:
        """Let UAVs hold, return or resume; returns which."""
        fleet = self.fleet(name)
        uavs = fleet.uavs if command.uavs is None else command.uavs
        for uav in uavs:
            fleet.number_of(uav, "uavs")
        clock = max(now, fleet.clock)
        line = Commanded.model_construct(command=command.command, uavs=uavs, received=clock)
        self._write(name, line)
        replay(fleet, line)
        return uavs

    def change_members(self, name: str, change: Change, now: float) -> list[str]:
        """Let UAVs join with their first reports, and leave now; returns the members from now on."""
        fleet = self.fleet(name)
        fleet.check_change(change.join, change.leave)
        clock = max(now, fleet.clock)
        line = Members.model_construct(join=change.join, leave=change.leave, received=clock)
        self._write(name, line)
        replay(fleet, line)
        return fleet.uavs

    def upkeep(self, clock: Callable[[], float]) -> Iterator[None]:
        """Bring fleets up to date, one after the other; snapshots take a part of the time only."""
        spent = 0.0
        for name in [name for name in self.names if name not in self._unreadable]:
            if name in self.fleets or name in self._journals:
                with suppress(RunError):  # a request says so; the other fleets go on
                    if self.fleet(name).changes_by_itself:  # another one skips quiet steps when it is asked
                        self.fleet(name).advance(clock())
                    began = clock()
                    due = began >= self._saved.get(name, 0.0) + SNAPSHOT_PERIOD and spent < SNAPSHOT_TIME
                    if due and self._unsaved.get(name, 0) >= SNAPSHOT_LINES:
                        self._save(name)
                        self._saved[name] = clock()
                        spent += self._saved[name] - began
                yield

    def close(self) -> None:
        """Store all fleets, and leave their folder to others."""
        with suppress(RunError):  # the journals have it all
            for name in [name for name, lines in self._unsaved.items() if lines and name in self.fleets]:
                self._save(name)
        self._journals.clear()
        self._at_close.close()

    def _write(self, name: str, line: Line) -> None:
        if self._folder is not None:
            try:
                self._journals[name].append(line)
            except RunError as error:
                self.problem = str(error)
                raise
            self.problem = None
            self._unsaved[name] = self._unsaved.get(name, 0) + 1

    def _save(self, name: str) -> None:
        """Store what a fleet knows, so that a restart reads only the lines of its journal after that."""
        journal, content = self._journals[name], io.BytesIO()
        fleet = self.fleets[name]
        mark = damian.__version__, fleet.mark
        torch.save({"mark": mark, "end": journal.end, "state": fleet.state()}, content)
        path = journal.path.with_suffix(SNAPSHOT)
        part = path.with_suffix(UNFINISHED)
        with writing(path):
            part.write_bytes(content.getvalue())
            part.replace(path)
        self._unsaved[name] = 0

    def _find(self, path: Path) -> None:
        """Find the journal of a fleet, and check that it is of these settings."""
        journal = Journal(path)  # removes what is unfinished
        if not journal.end:  # the service was killed before the fleet was there
            path.unlink()
            return
        head = read_head(path)
        with named(path):
            if head.fleet != path.stem:
                raise InputError(f"it is the journal of the fleet {head.fleet}: name it {head.fleet}{SUFFIX}")
            check_same(head.about, self.about)
            if head.ground != mark_of(self.make(head.uavs, head.mark).ground):
                raise InputError("it is of other landing points: give the region and the lattice that it had")
        self._journals[path.stem] = journal

    def _restored(self, journal: Journal) -> Fleet:
        """A fleet as its journal tells, from its snapshot on, if there is one that can be read."""
        head, path = read_head(journal.path), journal.path.with_suffix(SNAPSHOT)
        fleet, end = self.make(head.uavs, head.mark), 0
        if path.exists():
            try:
                with torch.serialization.safe_globals(STORED):
                    stored = torch.load(path, weights_only=True)
                if stored["mark"] == (damian.__version__, head.mark) and stored["end"] <= journal.end:
                    fleet.restore(stored["state"])
                    end = stored["end"]
            except Exception as error:  # a machine stopped while it was written; the journal has it all
                _LOG.warning("%s: it is not read: %s", path, described(error))
                fleet = self.make(head.uavs, head.mark)
        n_lines = 0
        for number, line in read_lines(journal.path, end):
            with named(f"{journal.path}: line {number}{' of those after the snapshot' if end else ''}"):
                replay(fleet, line)
            n_lines += 1
        self._unsaved[journal.path.stem] = n_lines
        return fleet


def rules_of(fleet: Fleet) -> dict[str, bool | float]:
    """The settings that a fleet holds to."""
    return {each.name: getattr(fleet.rules, each.name) for each in fields(FieldRules)}


def replay(fleet: Fleet, line: Line) -> None:
    """Repeat in a fleet what a line of its journal records."""
    if isinstance(line, Received):
        for report in line.reports:
            fleet.check(report)
        _taken(fleet, line.reports)
    elif isinstance(line, Acknowledged):
        _acknowledged(fleet, line)
    elif isinstance(line, Commanded):
        fleet.command(line.command, line.uavs or [], line.received)
    elif isinstance(line, Members):
        fleet.change_members(line.join, line.leave, line.received)
    elif fleet.start is None:
        raise InputError("advice before every UAV has reported")
    else:
        _advised(fleet, line)


def _advised(fleet: Fleet, line: Advised) -> None:
    """Let UAVs be told again what they were told."""
    fleet.advance(line.asked)
    chosen: dict[int, Any] = {}
    instead: dict[int, tuple[str, str]] = {}
    for uav, told in line.told.items():
        number = fleet.number_of(uav)
        if isinstance(told, tuple) and isinstance(told[0], str):
            instead[number] = (told[0], str(told[1]))
        else:
            chosen[number] = told
    hidden = None if fleet.hidden is None else fleet.ask_policy([*chosen])[1]
    spec = fleet.node.env.full_action_spec[keys.ACTION]
    action = spec.zero()
    for number, one in chosen.items():
        action[0, number] = torch.tensor(one)
    if not spec.is_in(action):
        raise InputError(f"told: {show(line.told)} are not all actions of these settings")
    fleet.tell(fleet.choice([*chosen], action, hidden, instead))


def _acknowledged(fleet: Fleet, line: Acknowledged) -> list[str]:
    """Give acknowledgements to a fleet."""
    rows = enumerate(line.acknowledged)
    return [fleet.acknowledge(row, line.received, i in line.outdated) for i, row in rows]


def _taken(fleet: Fleet, reports: Sequence[Report]) -> list[str]:
    """Give checked reports to a fleet, in the order in which they came in."""
    order = sorted(range(len(reports)), key=lambda i: reports[i].received)
    found = {i: fleet.report(reports[i]) for i in order}
    return [found[i] for i in range(len(reports))]


def check_same(then: About, now: About) -> None:
    """Check that a journal is of this policy and these settings, on which its actions depend."""

    def settings(about: About) -> dict[str, str | None]:
        parts = [word.lstrip("+").partition("=") for word in about.overrides]
        kept = {key: value for key, _, value in parts if key.split(".")[0] not in MAY_DIFFER}
        return {**kept, "policy": about.policy, "checkpoint": about.checkpoint}

    was, own = settings(then), settings(now)
    differ = [
        f"{key}: {was.get(key, 'not given')} then, {own.get(key, 'not given')} now"
        for key in {**was, **own}
        if was.get(key) != own.get(key)
    ]
    if differ:
        raise InputError(f"it is of other settings: {'; '.join(differ)}: give the same")
