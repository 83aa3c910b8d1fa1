"""Answers of the service: where each UAV should go next, and what is known of a fleet."""

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from damian.advice.fleet import Fleet

CALENDAR = 1e8
"""From this time on [s], times count from 1970 and are written as dates."""
Answer = dict[str, Any]


def advice_of(fleet: Fleet, uavs: Sequence[int] | None = None) -> list[Answer]:
    """What UAVs have been told last, as rows.

    ``state`` is ``fly`` or ``hold`` for a UAV that has chosen in this step, ``bound`` for one that was told
    so before, and ``none`` for one that has not been told anything.

    Args:
        fleet: the fleet, which has begun.
        uavs: numbers of the UAVs; all if not given.
    """
    return [_advice(fleet, uav) for uav in (range(len(fleet.uavs)) if uavs is None else uavs)]


def _advice(fleet: Fleet, uav: int) -> Answer:
    decision, held, ground = fleet.decision(uav), fleet.held[uav], fleet.ground
    first, second = ground.columns
    age = max(fleet.clock - held.report.time, 0.0)
    if decision is None:
        nothing = dict.fromkeys((first, second, "heading", "distance", "duration", "arrival", "step"))
        return {"ID": fleet.uavs[uav], "state": "none", **nothing, "age": round(age, 3)}
    distance, heading = ground.way(decision.origin, decision.goal)
    moves = decision.goal != decision.origin
    state = ("fly" if moves else "hold") if decision.step == fleet.step else "bound"
    place = ground.place(decision.goal)
    return {
        "ID": fleet.uavs[uav],
        "state": state,
        first: place[0],
        second: place[1],
        "heading": heading if moves else None,
        "distance": distance,
        "duration": round(decision.duration, 2),
        "arrival": written(decision.time + decision.duration),
        "step": decision.step,
        "age": round(age, 3),
    }


def status_of(fleet: Fleet) -> Answer:
    """What is known of a fleet: where its UAVs are believed to be, and how their reports come in."""
    rows = []
    for uav, log in zip(fleet.uavs, fleet.logs, strict=True):
        newest = log.newest
        age = None if newest is None else round(max(fleet.clock - newest.report.time, 0.0), 3)
        place = None if newest is None else dict(zip(fleet.ground.columns, newest.report.place, strict=True))
        counts = {"reports": log.received, "late": log.late, "duplicates": log.duplicates}
        rows.append({"ID": uav, "age": age, **(place or {}), **counts})
    start = None if fleet.start is None else written(fleet.start)
    return {"start": start, "step": fleet.step, "dt": fleet.node.dt, "uavs": rows}


def written(time: float) -> float | str:
    """A time: as a date (ISO 8601, UTC), or in seconds if it does not count from 1970."""
    if time < CALENDAR:
        return round(time, 3)
    return datetime.fromtimestamp(time, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
