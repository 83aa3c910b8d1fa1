"""Fleets in a database: each request is one transaction, which stores its event before it is answered.

A process that is killed at any instant leaves a database in which a request is there as a whole, or not at
all. A fleet is restored by applying its stored events again.
"""

import json
import re
import secrets
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from damian.common.counter_rng import number_of
from damian.common.errors import InputError, RunError
from damian.common.text_files import show
from damian.field.rows import Found, reports_of, validated, written
from damian_fleet.fleet import Event, Fleet
from damian_fleet.rows import Advice, Asking, Change, Command, FleetStatus, Members, acknowledgements_of

TABLES = """
PRAGMA locking_mode = EXCLUSIVE;
PRAGMA journal_mode = WAL;
PRAGMA synchronous = FULL;
CREATE TABLE IF NOT EXISTS fleets(
    id INTEGER PRIMARY KEY, name TEXT NOT NULL, head TEXT NOT NULL, ended REAL);
CREATE UNIQUE INDEX IF NOT EXISTS running ON fleets(name) WHERE ended IS NULL;
CREATE TABLE IF NOT EXISTS events(
    fleet INTEGER NOT NULL, n INTEGER NOT NULL, time REAL NOT NULL, event TEXT NOT NULL,
    PRIMARY KEY (fleet, n)) WITHOUT ROWID;
"""
"""With FULL, what was committed also survives a loss of power. The lock is that of one service."""


NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")


class NoFleet(InputError):
    """There is no fleet of this name."""


class Fleets:
    """The fleets of a service.

    Args:
        make: makes a fleet of UAVs, whose answers begin with a mark, as of the time of its latest event.
        path: the database; None to keep nothing.
        about: by which policy and settings fleets are advised; others may not go on with them.
    """

    def __init__(
        self, make: Callable[[list[str], str, float], Fleet], path: Path | None, about: Mapping[str, Any]
    ) -> None:
        self.make, self.about = make, dict(about)
        self.problem: str | None = None
        """Why the last request could not be stored; None if it could."""
        self.loaded: dict[str, Fleet] = {}
        """Fleets at hand; another one is restored when it is asked for."""
        self._ids: dict[str, int] = {}
        try:
            options: Any = {"timeout": 1, "isolation_level": None, "check_same_thread": False}
            self._base = sqlite3.connect(path or ":memory:", **options)
            self._base.executescript(TABLES)
            rows = self._base.execute("SELECT name, id, head FROM fleets WHERE ended IS NULL").fetchall()
        except sqlite3.Error as error:
            raise InputError(f"database: {path} cannot be used: {error}") from None
        for name, key, head in rows:
            self._check(name, json.loads(head)["about"])
            self._ids[name] = key

    def _check(self, name: str, then: dict[str, Any]) -> None:
        """Refuse to go on with a fleet by another policy or other settings."""
        both = {key: [each.get(key, "not given") for each in (then, self.about)] for key in then | self.about}
        differ = "; ".join(f"{key}: {was} then, {now} now" for key, (was, now) in both.items() if was != now)
        if differ:
            raise InputError(f"database: fleet {name} is of other settings: {differ}: give the same")

    @property
    def names(self) -> list[str]:
        """The names of all fleets."""
        return sorted(self._ids)

    @property
    def latest(self) -> float:
        """The latest time that is stored [s]; 0 if there is none."""
        return self._base.execute("SELECT coalesce(max(time), 0.0) FROM events").fetchone()[0]

    def _id(self, name: str) -> int:
        if name not in self._ids:
            raise NoFleet(f"fleet: there is no fleet {show(name)}")
        return self._ids[name]

    def fleet(self, name: str) -> Fleet:
        """The fleet of a name."""
        if name not in self.loaded:
            key, newest = self._id(name), "(SELECT max(time) FROM events WHERE fleet = id)"
            found = self._base.execute(f"SELECT head, {newest} FROM fleets WHERE id = ?", (key,))
            text, latest = found.fetchone()
            head = json.loads(text)
            fleet = self.make(head["uavs"], head["mark"], latest or 0.0)
            if head["ground"] != _mark(fleet):
                raise RunError(f"database: fleet {name} is of other landing points: give its region")
            for event in self._events(key):
                fleet.apply(json.loads(event))
            self.loaded[name] = fleet
        return self.loaded[name]

    def _events(self, key: int) -> Iterator[str]:
        rows = self._base.execute("SELECT event FROM events WHERE fleet = ? ORDER BY n", (key,))
        return (event for (event,) in rows)

    def _store(self, line: str, *values: Any) -> None:
        """Write a line of SQL in one transaction, or nothing."""
        try:
            self._base.execute(line, values)
        except sqlite3.Error as error:
            self.problem = f"database: it cannot be written: {error}"
            raise RunError(self.problem) from None
        self.problem = None

    def _take(self, name: str, event: Event) -> list[str]:
        """Store an event, and then apply it; returns what became of its rows."""
        text, time = json.dumps(event, allow_nan=False), event.get("received", event.get("asked"))
        line = "INSERT INTO events SELECT ?, coalesce(max(n), 0) + 1, ?, ? FROM events WHERE fleet = ?"
        self._store(line, key := self._id(name), time, text, key)
        return self.fleet(name).apply(json.loads(text))

    # Requests.

    def create(self, name: str, uavs: Sequence[str]) -> bool:
        """Create a fleet of UAVs with these IDs; returns whether it is new."""
        uavs = validated(Members, {"uavs": uavs}).uavs
        if not NAME.fullmatch(name):
            raise InputError(f"fleet: {show(name)} is not a name of up to 64 letters, digits, _ and -")
        if name in self._ids:
            if [*self.fleet(name).uavs] != uavs:
                raise InputError(f"fleet: {name} has other UAVs; end it first, or take another name")
            return False
        mark = secrets.token_hex(3)  # tells its answers from those of an earlier fleet of this name
        made = self.make(uavs, mark, 0.0)
        head = {"journal": "damian-advice", "version": 3, "fleet": name, "uavs": uavs, "mark": mark}
        head |= {"about": self.about, "ground": _mark(made)}
        self._store("INSERT INTO fleets(name, head) VALUES (?, ?)", name, json.dumps(head))
        (self._ids[name],) = self._base.execute("SELECT last_insert_rowid()").fetchone()
        self.loaded[name] = made
        return True

    def end(self, name: str, now: float) -> None:
        """End a fleet; what happened to it stays in the database."""
        self._store("UPDATE fleets SET ended = ? WHERE id = ?", now, self._id(name))
        del self._ids[name]
        self.loaded.pop(name, None)

    def report(self, name: str, rows: Found, now: float) -> dict[str, Any]:
        """Take reports, all or none."""
        fleet, reports = self.fleet(name), reports_of(rows)
        ignored = sorted({column for _, report in reports for column in report.model_extra or ()})
        found = self._take(name, fleet.reported(reports, now))
        return {"accepted": len(found), "found": found, "ignored": ignored}

    def advise(self, name: str, uavs: Sequence[str] | None, now: float) -> list[Advice]:
        """Let the UAVs that ask choose, all if None; what they are told."""
        fleet, asking = self.fleet(name), validated(Asking, {"uavs": uavs}).uavs
        event = fleet.advised(asking, now)
        if event is not None:
            self._take(name, event)
        return [fleet.shown(uav, fleet.clock) for uav in fleet.members(asking, "uavs")]

    def acknowledge(self, name: str, rows: Found, now: float) -> list[str]:
        """Take acknowledgements, all or none; how far the answers have come, or ``unknown``."""
        fleet = self.fleet(name)
        return self._take(name, fleet.acknowledged(acknowledgements_of(rows), now))

    def command(self, name: str, command: str, uavs: Sequence[str] | None, now: float) -> list[str]:
        """Let UAVs hold, return or resume; returns which."""
        event = self.fleet(name).commanded(validated(Command, {"command": command, "uavs": uavs}), now)
        self._take(name, event)
        return event["uavs"]

    def change_members(self, name: str, join: Sequence[str], leave: Sequence[str], now: float) -> list[str]:
        """Let UAVs join with their first reports, and leave now; returns the members from now on."""
        fleet = self.fleet(name)
        self._take(name, fleet.changed(validated(Change, {"join": join, "leave": leave}), now))
        return [*fleet.uavs]

    def status(self, name: str, now: float) -> FleetStatus:
        """What is known of a fleet; changes nothing."""
        fleet = self.fleet(name)
        tracker, now = fleet.tracker, max(now, fleet.clock)
        uavs = [fleet.status(uav, now) for uav in fleet.uavs.values()]
        start = written(tracker.start) if tracker.has_begun else None
        return FleetStatus(fleet=name, start=start, step=tracker.step, dt=fleet.node.dt, uavs=uavs)

    def journal(self, name: str) -> Iterator[str]:
        """What happened to a fleet, also to one that has ended, for ``damian fly`` and ``damian advise``."""
        line = "SELECT id, head FROM fleets WHERE name = ? ORDER BY id DESC"
        found = self._base.execute(line, (name,)).fetchone() or (self._id(name), "")
        yield found[1]
        yield from self._events(found[0])

    def close(self) -> None:
        """Leave the database to others."""
        self._base.close()


def _mark(fleet: Fleet) -> str:
    """A text that stands for the landing points of a fleet."""
    return str(number_of(str(fleet.ground.points.round(2).tolist())))
