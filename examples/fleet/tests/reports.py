"""UAVs of a simulation that report as real ones would, late, out of order and with losses."""

import json
from pathlib import Path
from typing import Any

import torch

from damian import keys
from damian.world.config import RegionConfig
from damian_fleet.known import Ground
from damian_fleet.reports import Rows, reports_of, rows_of_json

START = 1.7e9
"""When the simulated flights begin [s since 1970]."""
LLANBEDR = RegionConfig(kind="fir", path="damian:fir.csv", id="LlanbedrTest", initial_conditions=1)
"""With a single initial condition, whose table of first observations rounds as that of a single
fleet."""


def names_of(n: int) -> list[str]:
    return [f"uav-{i}" for i in range(n)]


class Reporter:
    """What the UAVs of a simulated world say, as rows of JSON.

    Args:
        env: environment with the extra ``message``.
        ground: landing points of the service.
        fraction: share of a step after its beginning at which messages are generated.
        start: when the flight begins [s].
    """

    def __init__(self, env, ground: Ground, fraction: float = 0.0, start: float = START) -> None:
        self.env = env
        self.ground = ground
        self.fraction = fraction
        self.start = start
        self.dt = env.uav_env.scenario.clock.dt
        self.points = env.uav_env.simulation.airspace.points[0]
        self.in_transit: list[tuple[int, int, dict[str, Any]]] = []
        self.n_sent = [0] * env.uav_env.n_agents

    def number_at(self, xy: torch.Tensor) -> int:
        return int((self.points - xy).square().sum(-1).argmin())

    def time_of(self, step: float) -> float:
        return self.start + (step + self.fraction) * self.dt

    def row(self, messages, uav: int, step: int) -> dict[str, Any]:
        """What one UAV says in a step."""

        def place(xy) -> tuple[float, float]:
            return self.ground.place(self.number_at(xy))

        at = place(messages.position[uav])
        bound = place(messages.target[uav])
        first, second = self.ground.columns
        flying = bool((messages.position[uav] != messages.target[uav]).any())
        row = {
            "ID": names_of(uav + 1)[uav],
            "time": self.time_of(step),
            first: at[0],
            second: at[1],
            "source_spotted": int(messages.spotted[uav]),
            "track": float(torch.rad2deg(messages.track[uav].double())),
            "battery": float(messages.battery[uav]),
            "FLA": 5.0 if flying else 0.0,
            f"target {first}": bound[0],
            f"target {second}": bound[1],
            "motions": int(messages.motions[uav]),
            "previous": [list(self.ground.place(int(p))) for p in messages.trail[uav, 1:]],
            "sequence": self.n_sent[uav],
            "landed": [
                self.time_of(round(t / self.dt)) for t in messages.landed[uav].tolist() if t >= 0
            ],
        }
        seen = float(messages.detected_time[uav, 0])
        if seen >= 0:
            there = place(messages.detected_position[uav, 0])
            row |= {"source time": self.time_of(round(seen / self.dt))}
            row |= {f"source {first}": there[0], f"source {second}": there[1]}
        return row

    def send(self, outputs, step: int, at_once: bool = False) -> None:
        """Send what the UAVs say after a step, with the delays that the simulation has drawn."""
        messages = self.env.server.messages(outputs[keys.MESSAGE])
        one = type(messages)._make(field[0] for field in messages)
        for uav in range(one.time.shape[0]):
            known = at_once or keys.DELAY not in outputs.keys(True)
            delay = 0 if known else int(outputs[keys.DELAY][0, uav])
            sent = at_once or bool(outputs[keys.MESSAGE_SENT][0, uav])
            self.n_sent[uav] += sent
            if sent and delay >= 0:
                self.in_transit.append((step + delay, uav, self.row(one, uav, step)))

    def arriving(self, step: int) -> list[dict[str, Any]]:
        """The rows that arrive in a step, in any order."""
        here = [row for due, _, row in self.in_transit if due == step]
        self.in_transit = [each for each in self.in_transit if each[0] != step]
        return here[::-1]


def read_json(rows: Any) -> Rows:
    """A row, or rows, as the service reads them from JSON."""
    return reports_of(rows_of_json(json.dumps(rows)))


def write_journal(path: Path, *lines: dict[str, Any], uavs: list[str]) -> Path:
    """A journal of lines after the first one."""
    about = {
        "policy": "script",
        "checkpoint": "runs/gone",
        "overrides": ["region=llanbedr", "port=0"],
    }
    head = {
        "journal": "damian-advice",
        "version": 3,
        "fleet": "north",
        "uavs": uavs,
        "about": about,
    }
    path.write_text("".join(json.dumps(line) + "\n" for line in [head, *lines]), encoding="utf-8")
    return path
