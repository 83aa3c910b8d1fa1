"""Several fleets with their journals: what all sources of reports (files, folders, HTTP) have in common."""

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from damian import keys
from damian.advice.answers import Answer, advice_of, status_of
from damian.advice.fleet import Fleet
from damian.advice.journal import SUFFIX, Journal, entries, head, reports_of
from damian.advice.reports import Report, read_rows
from damian.advice.same_service import check_goals, check_same
from damian.advice.tables import Rows
from damian.common.atomic_files import writing
from damian.common.errors import InputError, RunError
from damian.common.text_files import named, show
from damian.runs.run_lock import is_folder, locked

MAX_FLEETS, MAX_UAVS = 1000, 100
NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")


class NoFleet(InputError):
    """There is no fleet of this name."""


class Desk:
    """The fleets of a service.

    Args:
        make_fleet: makes the fleet of UAVs with these IDs.
        folder: of the journals; those in it are restored, and no other desk may use it until this one is
            closed. None: nothing is kept.
        about: which policy flies by which settings, for the journals: ``policy``, ``checkpoint`` and
            ``overrides``.
        durable: as in ``Journal``.
        is_locked: the folder is locked by who makes the desk.

    Raises:
        InputError: a journal is damaged, or of another policy or other settings, or another desk uses the
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
        self.about = dict(about or {})
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

    def check_new(self, name: str, uavs: Any) -> list[str]:
        """Check the name and the UAVs of a fleet; returns their IDs.

        Raises:
            InputError: they are not valid, or the fleet exists with other UAVs.
        """
        if not NAME.fullmatch(name):
            raise InputError(f"fleet: {show(name)} is not 1 to 64 letters, digits, _ and -")
        ids = checked_ids(uavs)
        if name in self.fleets and self.fleets[name].uavs != ids:
            raise InputError(f"fleet: {name} has other UAVs; end it first, or take another name")
        if name not in self.fleets and len(self.fleets) >= MAX_FLEETS:
            raise InputError(f"fleet: there are {MAX_FLEETS} fleets already; end one first")
        return ids

    def create(self, name: str, uavs: list[str], fleet: Fleet | None = None) -> bool:
        """Create a fleet of checked UAVs; returns whether it is new.

        Args:
            name: of the fleet.
            uavs: IDs of its UAVs.
            fleet: made of them, if it has been made already.
        """
        if name in self.fleets:
            return False
        made = fleet or self.make(uavs)
        if self._folder is not None:
            journal = Journal(self._folder / f"{name}{SUFFIX}", self._durable)
            try:
                journal.append(head(name, uavs, self.about))
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
            journal.close()
            try:
                with writing(journal.path):
                    journal.path.rename(journal.path.with_suffix(f".{now:.3f}.ended"))
            except RunError:
                self._journals[name] = Journal(journal.path, self._durable)
                raise
            del self._journals[name]
        del self.fleets[name]

    def report(self, name: str, rows: Rows, now: float, file: bool = False) -> list[str]:
        """Take reports, all or none of them.

        Args:
            name: of the fleet.
            rows: of a table.
            now: when they came in [s].
            file: they are from a file, whose column ``receive time`` counts.

        Returns:
            What was found of each, as ``Fleet.report`` says it. They are in the journal by then.

        Raises:
            InputError: a row is wrong; none is taken.
            RunError: the journal cannot be written; none is taken.
        """
        fleet, reports = self.fleet(name), read_rows(rows, now, file)
        current, now = (None, now) if file else (now, max(now, fleet.clock))
        for (where, _), report in zip(rows, reports, strict=True):
            try:
                fleet.check(report, now if report.received is None else report.received, current)
            except InputError as error:
                raise InputError(f"{where}: {error}") from None
        kept = [
            {column: value for column, value in row.items() if column not in ("aoi", "receive time")}
            | {"time": report.time}
            for (_, row), report in zip(rows, reports, strict=True)
        ]
        self._write(name, {"received": now, "reports": kept})
        return _taken(fleet, reports, now)

    def advise(
        self, name: str, now: float, asking: Sequence[str] | None = None, only: bool = False
    ) -> list[Answer]:
        """Let UAVs choose, and say what all of them were told last; arguments as of ``Fleet.advise``.

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
        numbers = fleet.numbers_of(asking)
        fleet.advance(now)
        before = fleet.choices()
        choosing = fleet.advise(now, asking)
        answer = advice_of(fleet, numbers if only else None)
        if choosing:
            told = {fleet.uavs[uav]: fleet.told[uav][-1].action for uav in choosing}
            advice = answer if numbers is None else advice_of(fleet, choosing)
            try:
                self._write(name, {"asked": fleet.clock, "step": fleet.step, "told": told, "advice": advice})
            except BaseException:  # nobody is told what is in no journal
                fleet.take_back(before)
                raise
        return answer

    def status(self, name: str) -> Answer:
        """What is known of a fleet."""
        return {"fleet": name, **status_of(self.fleet(name))}

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

    def _open(self, folder: Path, is_locked: bool) -> None:
        """Take a folder of journals, and restore the fleets in it."""
        is_new = not is_folder(folder)
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        if not is_locked:
            self._at_close.enter_context(locked(folder, "journal"))
        if is_new:
            self._at_close.callback(_remove_if_empty, folder)
        for path in sorted(folder.glob(f"*{SUFFIX}")):
            self._restore(path)

    def _write(self, name: str, entry: dict[str, Any]) -> None:
        if self._folder is not None:
            self._journals[name].append(entry)

    def _restore(self, path: Path) -> None:
        """Restore a fleet from its journal."""
        journal = Journal(path, self._durable)  # removes what is unfinished
        if not path.stat().st_size:  # it was killed before the fleet was there
            journal.close()
            path.unlink()
            return
        try:
            name, fleet = self._replayed(path)
        except BaseException:
            journal.close()
            raise
        self.fleets[name], self._journals[name] = fleet, journal

    def _replayed(self, path: Path) -> tuple[str, Fleet]:
        """The fleet of a journal, and its name."""
        first, *others = entries(path)
        name = first["fleet"]
        with named(path):
            check_same(first.get("about"), self.about)
            uavs = self.check_new(name, first.get("uavs"))
            if path.name != f"{name}{SUFFIX}":
                remedy = f"name it {name}{SUFFIX}, or move it to another folder"
                raise InputError(f"it is the journal of the fleet {name}, or a copy of it: {remedy}")
            fleet = self.make(uavs)
        for number, entry in enumerate(others, 2):
            with named(f"{path}: line {number}"):
                replay(fleet, entry)
                check_goals(fleet, entry)
        return name, fleet


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()


def checked_ids(uavs: Any) -> list[str]:
    """The IDs of the UAVs of a fleet.

    Raises:
        InputError: they are not a list of IDs, or two are the same.
    """
    if not (isinstance(uavs, list) and 0 < len(uavs) <= MAX_UAVS and all(map(_is_id, uavs))):
        problem = f"is not a list of the IDs of 1 to {MAX_UAVS} UAVs, each of 1 to 64 printable characters"
        raise InputError(f"uavs: {show(uavs)} {problem}")
    ids = [str(uav).strip() for uav in uavs]
    if len({*ids}) < len(ids):
        raise InputError(f"uavs: {show(ids)} names a UAV twice")
    return ids


def replay(fleet: Fleet, entry: Mapping[str, Any]) -> None:
    """Do again what a line of a journal says."""
    if "reports" in entry:
        received, reports = reports_of(entry)
        for report in reports:
            fleet.check(report, received)
        _taken(fleet, reports, received)
        return
    asked, told = entry.get("asked"), entry.get("told")
    if not isinstance(asked, int | float) or not isinstance(told, dict):
        raise InputError("it is damaged: neither reports nor advice")
    if fleet.start is None:
        raise InputError("it is damaged: advice before every UAV has reported")
    fleet.advance(asked)
    numbers = fleet.numbers_of(list(told)) or []
    if fleet.hidden is not None:
        fleet.ask_policy(numbers)  # for its hidden states
    action = fleet.node.env.full_action_spec[keys.ACTION].zero()
    for uav, chosen in told.items():
        action[0, fleet.number[uav]] = _action(chosen, action[0, 0])
    fleet.choose(numbers, action)


def _action(chosen: Any, like: Tensor) -> Tensor:
    """The action that a journal names, in the type of another one."""
    try:
        return torch.as_tensor(chosen).to(like.dtype).view(like.shape)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"it is damaged: {show(chosen)} is no action") from None


def _taken(fleet: Fleet, reports: Sequence[Report], now: float) -> list[str]:
    """Give checked reports to a fleet, in the order in which they came in."""

    def received(report: Report) -> float:
        return now if report.received is None else report.received

    order = sorted(range(len(reports)), key=lambda i: received(reports[i]))
    found = {i: fleet.report(reports[i], received(reports[i])) for i in order}
    return [found[i] for i in range(len(reports))]


def _is_id(uav: Any) -> bool:
    text = str(uav).strip()
    return (
        isinstance(uav, str | int)
        and not isinstance(uav, bool)
        and 0 < len(text) <= 64
        and text.isprintable()
    )
