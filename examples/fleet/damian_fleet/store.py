"""Fleets in a database: each request is one transaction, which stores its event before it is
answered.

A process that is killed at any instant leaves a database in which a request is there as a whole, or
not at all. A fleet is restored by applying its stored events again.
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
from damian_fleet.fleet import Event, Fleet

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
        make: makes a fleet of UAVs, whose answers begin with a mark, as of the time of its latest
            event.
        path: the database; ``:memory:`` to keep nothing.
        about: by which policy and settings fleets are advised; others may not go on with them.
    """

    def __init__(
        self,
        make: Callable[[list[str], str, float], Fleet],
        path: str | Path,
        about: Mapping[str, Any],
    ) -> None:
        self.make = make
        self.about = dict(about)
        self.problem: str | None = None
        """Why the last request could not be stored; None if it could."""
        self.loaded: dict[str, Fleet] = {}
        """Fleets at hand; another one is restored when it is asked for."""
        try:
            options: Any = {"timeout": 1, "isolation_level": None, "check_same_thread": False}
            self._base = sqlite3.connect(path, **options)
            self._base.executescript(TABLES)
            rows = self._base.execute(
                "SELECT name, id, head FROM fleets WHERE ended IS NULL"
            ).fetchall()
        except sqlite3.Error as error:
            raise InputError(f"database: {path} cannot be used: {error}") from None
        self._ids = {name: key for name, key, _ in rows}
        for name, _, head in rows:
            then = json.loads(head)["about"]
            differ = [key for key in then | self.about if then.get(key) != self.about.get(key)]
            told = (f"{key}: {then.get(key)} then, {self.about.get(key)} now" for key in differ)
            if differ:
                raise InputError(f"database: fleet {name} is of other settings: {'; '.join(told)}")

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

    def __getitem__(self, name: str) -> Fleet:
        """The fleet of a name."""
        if name not in self.loaded:
            key = self._id(name)
            newest = "(SELECT max(time) FROM events WHERE fleet = id)"
            found = self._base.execute(f"SELECT head, {newest} FROM fleets WHERE id = ?", (key,))
            text, latest = found.fetchone()
            head = json.loads(text)
            fleet = self.make(head["uavs"], head["mark"], latest or 0.0)
            if head["ground"] != _mark(fleet):
                raise RunError(
                    f"database: fleet {name} is of other landing points: give its region"
                )
            for event in self._events(key):
                fleet.apply(json.loads(event))
            for lease in fleet.leases.values():
                lease.seen = None  # from now on it counts
            self._serve(name, fleet)
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

    def take(
        self, name: str, request: Callable[[Fleet, Any, float], Event | None], said: Any, now: float
    ) -> list[str]:
        """Store the event that a request of a fleet is, such as ``Fleet.reported``, and then apply
        it.

        Returns:
            What became of it, as of ``Fleet.apply``; nothing if the request changes nothing.
        """
        fleet = self[name]
        if (event := request(fleet, said, now)) is None:
            return []
        text = json.dumps(event, allow_nan=False)
        line = (
            "INSERT INTO events SELECT ?, coalesce(max(n), 0) + 1, ?, ? FROM events WHERE fleet = ?"
        )
        self._store(line, key := self._id(name), event["received"], text, key)
        return fleet.apply(json.loads(text))

    def create(self, name: str, uavs: Sequence[str]) -> bool:
        """Create a fleet of UAVs with these IDs; returns whether it is new."""
        if not NAME.fullmatch(name):
            raise InputError(
                f"fleet: {show(name)} is not a name of up to 64 letters, digits, _ and -"
            )
        if name in self._ids:
            if [*self[name].uavs] != [*uavs]:
                raise InputError(
                    f"fleet: {name} has other UAVs; end it first, or take another name"
                )
            return False
        mark = secrets.token_hex(3)  # tells its answers from those of an earlier fleet of this name
        made = self.make([*uavs], mark, 0.0)
        head = {
            "journal": "damian-advice",
            "version": 3,
            "fleet": name,
            "uavs": [*uavs],
            "mark": mark,
        }
        head |= {"about": self.about, "ground": _mark(made)}
        self._store("INSERT INTO fleets(name, head) VALUES (?, ?)", name, json.dumps(head))
        (self._ids[name],) = self._base.execute("SELECT last_insert_rowid()").fetchone()
        self._serve(name, made)
        return True

    def _serve(self, name: str, fleet: Fleet) -> None:
        fleet.others = self.loaded.values
        self.loaded[name] = fleet

    def end(self, name: str, now: float) -> None:
        """End a fleet; what happened to it stays in the database."""
        self._store("UPDATE fleets SET ended = ? WHERE id = ?", now, self._id(name))
        del self._ids[name]
        self.loaded.pop(name, None)

    def journal(self, name: str) -> Iterator[str]:
        """What happened to a fleet, also to one that has ended, as a journal."""
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
