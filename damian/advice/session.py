"""Several fleets with their journals: what all sources of reports (tables, folders, HTTP) have in common.

Each kind of request that changes a fleet does the same three things in this order: it checks, writes the line
of the journal, and then changes the fleet. So nothing is acknowledged that the journal does not say, and a
request that fails changes nothing. A new kind of request, such as an acknowledgement, is another method of
``AdviceSession`` of this form, with its line in ``journal.py``, its part of ``replay``, and its route in
``service.py``.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch

from damian import keys
from damian.advice.fleet import Fleet, Waiting
from damian.advice.journal import SUFFIX, About, Advised, Head, Journal, Line, Received, read_head, read_lines
from damian.advice.rows import (
    Advice,
    FleetRequest,
    FleetStatus,
    Report,
    Rows,
    as_csv,
    as_rows,
    read_file,
    validated,
)
from damian.common.atomic_files import write_atomically, writing
from damian.common.errors import InputError, RunError
from damian.common.text_files import named, show
from damian.runs.run_lock import LOCK, is_empty, locked

MAX_FLEETS = 1000
MAY_DIFFER = {
    *("reports", "folder", "port", "host", "token", "uavs", "journal", "durable"),
    *("policy", "checkpoint", "agents", "device", "frames", "episodes", "eval_episodes", "hydra"),
}
"""Settings that a journal and a service need not share: those that say how reports come in and where journals
lie, those that are compared apart, and those on which no advice depends."""
TOLERANCE = 0.01
"""Distance within which two places are the same [m]: those in journals are rounded to a millimetre."""


class NoFleet(InputError):
    """There is no fleet of this name."""


class AdviceSession:
    """The fleets of a service.

    Args:
        make_fleet: makes the fleet of UAVs with these IDs.
        folder: of the journals; those in it are restored, and no other session may use it until this one is
            closed. None: nothing is kept.
        about: which policy advises by which settings, for the journals, as ``About``.
        durable: as in ``Journal``.
        is_locked: the folder is locked by who makes the session.

    Raises:
        InputError: a journal is damaged, or of another policy or other settings, or another session uses the
            folder.
        RunError: the folder cannot be written.
    """

    def __init__(
        self,
        make_fleet: Callable[[list[str]], Fleet],
        folder: Path | None = None,
        about: Mapping[str, Any] | None = None,
        durable: bool = False,
        is_locked: bool = False,
    ) -> None:
        self.make, self._folder, self._durable = make_fleet, folder, durable
        self.about = About.model_validate(about or {})
        self.fleets: dict[str, Fleet] = {}
        self._journals: dict[str, Journal] = {}
        self._at_close = ExitStack()
        if folder is not None:
            try:
                self._open(folder, is_locked)
            except BaseException:
                self.close()
                raise

    def fleet(self, name: str) -> Fleet:
        """The fleet of a name.

        Raises:
            NoFleet: there is none.
        """
        if name not in self.fleets:
            raise NoFleet(f"fleet: there is no fleet {show(name)}")
        return self.fleets[name]

    def check_new(self, name: str, uavs: Any) -> Head:
        """Check the name and the UAVs of a fleet.

        Returns:
            The first line of its journal, with the name and the IDs of the UAVs.

        Raises:
            InputError: they are not valid, or the fleet exists with other UAVs.
        """
        ids = validated(FleetRequest, {"uavs": uavs}).uavs
        head = validated(Head, {"fleet": name, "uavs": ids, "about": self.about})
        if name in self.fleets and self.fleets[name].uavs != ids:
            raise InputError(f"fleet: {name} has other UAVs; end it first, or take another name")
        if name not in self.fleets and len(self.fleets) >= MAX_FLEETS:
            raise InputError(f"fleet: there are {MAX_FLEETS} fleets already; end one first")
        return head

    def create(self, name: str, uavs: Sequence[str], fleet: Fleet | None = None) -> bool:
        """Create a fleet; returns whether it is new.

        Args:
            name: of the fleet.
            uavs: IDs of its UAVs.
            fleet: made of them, if it has been made already.

        Raises:
            InputError: as of ``check_new``.
            RunError: the journal cannot be written; there is no such fleet.
        """
        head = self.check_new(name, list(uavs))
        if name in self.fleets:
            return False
        made = fleet or self.make(head.uavs)
        if self._folder is not None:
            journal = Journal(self._folder / f"{name}{SUFFIX}", self._durable)
            try:
                journal.append(head)
            except BaseException:
                journal.close()
                raise
            self._journals[name] = journal
        self.fleets[name] = made
        return True

    def end(self, name: str, now: float) -> None:
        """End a fleet; its journal stays, under another name.

        Raises:
            RunError: the journal cannot be renamed; the fleet goes on.
        """
        self.fleet(name)
        if journal := self._journals.get(name):
            with writing(journal.path):
                journal.path.rename(journal.path.with_suffix(f".{now:.3f}.ended"))
            journal.close()
            del self._journals[name]
        del self.fleets[name]

    def report(self, name: str, rows: Rows, now: float, file: bool = False) -> list[str]:
        """Take reports, all or none of them.

        Args:
            name: of the fleet.
            rows: the reports.
            now: when they came in [s].
            file: they are from a file, whose column ``receive time`` counts.

        Returns:
            What was found of each, as ``Fleet.report`` says it. They are in the journal by then.

        Raises:
            InputError: a row is wrong; none is taken.
            RunError: the journal cannot be written; none is taken.
        """
        fleet = self.fleet(name)
        clock = now if file else max(now, fleet.clock)
        for where, report in rows:
            with named(where):
                report.stamp(now, file)
                if not file:  # by the clock of the fleet, which never goes back
                    report.received = clock
                fleet.check(report, None if file else clock)
        reports = [report for _, report in rows]
        self._write(name, Received.model_construct(received=clock, reports=reports))
        return _taken(fleet, reports)

    def advise(
        self, name: str, now: float, asking: Sequence[str] | None = None, only: bool = False
    ) -> list[Advice]:
        """Let UAVs choose, and say what all of them were told last; arguments as of ``Fleet.choose``.

        Args:
            name: of the fleet.
            now: the time [s].
            asking: IDs of the UAVs that are ready to choose.
            only: answer only those that ask.

        Raises:
            InputError: a UAV is of another fleet, or the fleet began too long ago.
            Waiting: not every UAV has reported yet.
            RunError: the journal cannot be written; no UAV has chosen.
        """
        fleet = self.fleet(name)
        choice = fleet.choose(now, asking)
        if choice is not None:
            told = {fleet.uavs[uav]: decision.action for uav, decision in choice.decisions.items()}
            advice = [fleet.advice_of(*each) for each in choice.decisions.items()]
            line = Advised.model_construct(asked=fleet.clock, told=told, advice=advice)
            self._write(name, line)
            fleet.tell(choice)
        return fleet.advice(fleet.numbers_of(asking) if only else None)

    def status(self, name: str) -> FleetStatus:
        """What is known of a fleet."""
        return self.fleet(name).status(name)

    def advance(self, now: float) -> None:
        """Let all fleets take their steps, so that no answer has to wait for many of them."""
        for fleet in self.fleets.values():
            fleet.advance(now)

    def close(self) -> None:
        """Close all journals, and leave their folder to others."""
        for journal in self._journals.values():
            journal.close()
        self._journals.clear()
        self._at_close.close()

    def _write(self, name: str, line: Line) -> None:
        if self._folder is not None:
            self._journals[name].append(line)

    def _open(self, folder: Path, is_locked: bool) -> None:
        """Take a folder of journals, and restore the fleets in it."""
        is_new = not folder.is_dir()
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        if not is_locked:
            self._at_close.enter_context(locked(folder, "journal"))
        if is_new:
            self._at_close.callback(_remove_if_empty, folder)
        for path in sorted(folder.glob(f"*{SUFFIX}")):
            self._restore(path)

    def _restore(self, path: Path) -> None:
        """Restore a fleet from its journal."""
        journal = Journal(path, self._durable)  # removes what is unfinished
        try:
            if not path.stat().st_size:  # it was killed before the fleet was there
                path.unlink()
                journal.close()
                return
            head = read_head(path)
            with named(path):
                check_same(head.about, self.about)
                self.check_new(head.fleet, head.uavs)
                if path.name != f"{head.fleet}{SUFFIX}":
                    remedy = f"name it {head.fleet}{SUFFIX}, or move it to another folder"
                    raise InputError(
                        f"it is the journal of the fleet {head.fleet}, or a copy of it: {remedy}"
                    )
                fleet = self.make(head.uavs)
            for number, line in read_lines(path):
                with named(f"{path}: line {number}"):
                    replay(fleet, line)
                    check_goals(fleet, line)
        except BaseException:
            journal.close()
            raise
        self.fleets[head.fleet], self._journals[head.fleet] = fleet, journal


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):
        if is_empty(folder):
            (folder / LOCK).unlink(missing_ok=True)
            folder.rmdir()


def replay(fleet: Fleet, line: Line) -> None:
    """Do again what a line of a journal says.

    Raises:
        InputError: it cannot have happened.
    """
    if isinstance(line, Received):
        for report in line.reports:
            fleet.check(report)
        _taken(fleet, line.reports)
        return
    if fleet.start is None:
        raise InputError("it is damaged: advice before every UAV has reported")
    fleet.advance(line.asked)
    numbers, hidden = fleet.numbers_of(list(line.told)) or [], None
    if fleet.hidden is not None:
        _, hidden = fleet.ask_policy(numbers)
    spec = fleet.node.env.full_action_spec[keys.ACTION]
    action = spec.zero()
    for uav, chosen in line.told.items():
        given = torch.tensor(chosen, dtype=torch.float64 if isinstance(chosen, tuple) else torch.long)
        like = action[0, fleet.number[uav]]
        fits = given.shape == like.shape and given.is_floating_point() == like.is_floating_point()
        action[0, fleet.number[uav]] = given if fits else -1
    if not spec.is_in(action):
        raise InputError(f"it is damaged: told: {show(line.told)} are not all actions of these settings")
    fleet.tell(fleet.choice(numbers, action, hidden))


def _taken(fleet: Fleet, reports: Sequence[Report]) -> list[str]:
    """Give checked reports to a fleet, in the order in which they came in."""
    order = sorted(range(len(reports)), key=lambda i: reports[i].received)
    found = {i: fleet.report(reports[i]) for i in order}
    return [found[i] for i in range(len(reports))]


# Whether a journal is of a service like this one. It keeps actions and steps, which mean something else with
# another lattice, other actions or another length of a step: UAVs would be booked where nobody has sent them.


def check_same(then: About, now: About) -> None:
    """Check that a journal is of the policy and of the settings of this service.

    Raises:
        InputError: it is of others.
    """
    was, own = (
        {**_settings_of(each), "policy": each.policy, "checkpoint": each.checkpoint} for each in (then, now)
    )
    differ = [
        f"{key}: {was.get(key, 'not given')} then, {own.get(key, 'not given')} now"
        for key in {**was, **own}
        if was.get(key) != own.get(key)
    ]
    if differ:
        remedy = "give the same, or name another journal=FOLDER"
        raise InputError(f"it is of other settings: {'; '.join(differ)}: {remedy}")


def _settings_of(about: About) -> dict[str, str | None]:
    """What overrides set, by key, without what may differ; the last one of a key counts."""
    parts = [word.lstrip("+").partition("=") for word in about.overrides]
    return {key: value for key, _, value in parts if key.split(".")[0] not in MAY_DIFFER}


def check_goals(fleet: Fleet, line: Line) -> None:
    """Check that a line of a journal, which has been replayed, sends UAVs where they were sent.

    Raises:
        InputError: a UAV was told another landing point than its action leads to with these settings.
    """
    if isinstance(line, Received):
        return
    rows = {row.ID: row for row in line.advice}
    for uav in line.told:
        place, decision = uav in rows and rows[uav].place(), fleet.decision(fleet.number[uav])
        if not place or decision is None:
            raise InputError(f"it is damaged: it does not say where {uav} was sent")
        away = float(np.hypot(*(fleet.ground.points[decision.goal] - fleet.ground.local(place))))
        if not away <= TOLERANCE:
            there = f"{place[0]:.10g}, {place[1]:.10g}"
            wrong = f"{uav} was sent to {there}, {away:.2f} m from where its action leads"
            raise InputError(f"it is damaged, or of another region, lattice or actions: {wrong}")


# A folder as a source of reports: every table that is put into it is read once, and answered there.

TABLES = (".csv", ".json", ".jsonl")
ANSWERS = ("advice.csv", "advice.json")
DONE, REFUSED, REASON = ".done", ".refused", ".refused.txt"
"""Added to the name of a table that was read, or refused, and to that of the file that says why."""


def read_inbox(session: AdviceSession, name: str, folder: Path, now: float) -> bool:
    """Read the tables that have come into a folder, in the order of their names, and answer them.

    A table must appear complete: write it under another name, such as one that begins with a dot, and rename
    it. The answer is ``advice.csv`` and ``advice.json`` in the folder. A table that is wrong changes nothing.
    Files ``NAME.done``, ``NAME.refused`` and ``NAME.refused.txt`` are of the newest table of that name; the
    time is put into the names of those of an earlier one.

    Args:
        session: the fleets.
        name: of the fleet.
        folder: the folder.
        now: the time [s].

    Returns:
        Whether there was any table.

    Raises:
        RunError: the folder cannot be read any more, or an answer cannot be written.
    """
    try:
        paths = sorted(path for path in folder.iterdir() if _is_table(path))
    except OSError as error:
        raise RunError(f"folder: {folder}: it cannot be read: {error.strerror}") from None
    taken = [_read_table(session, name, path, now) for path in paths]
    if any(taken):
        with suppress(Waiting):
            write_answer(folder, session.advise(name, now))
    return bool(paths)


def write_answer(folder: Path, answer: list[Advice]) -> str:
    """Write the advice of a fleet into a folder, as ``ANSWERS``; returns its table.

    Raises:
        RunError: it cannot be written.
    """
    write_atomically(folder / "advice.json", json.dumps(as_rows(answer), indent=1))
    write_atomically(folder / "advice.csv", table := as_csv(answer))
    return table


def _is_table(path: Path) -> bool:
    hidden = path.name.startswith(".") or path.name in ANSWERS
    return not hidden and path.suffix.lower() in TABLES and path.is_file()


def _read_table(session: AdviceSession, name: str, path: Path, now: float) -> bool:
    """Give a table to the session; returns whether it was taken."""
    reason = ""
    try:
        session.report(name, read_file(path), now)
    except InputError as error:
        reason = str(error)
    with writing(path):
        for end in (DONE, REFUSED, REASON):  # those of an earlier table of this name
            earlier = path.with_name(path.name + end)
            if earlier.exists():
                earlier.rename(path.with_name(f"{path.name}.{now:.3f}{end}"))
        if reason:
            write_atomically(path.with_name(path.name + REASON), f"{reason}\n")
        path.rename(path.with_name(path.name + (REFUSED if reason else DONE)))
    return not reason
