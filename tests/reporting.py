"""UAVs of a simulation that report as real ones would, late, out of order and with losses."""

import json
from collections.abc import Iterator, Sequence
from typing import Any

import torch

from damian import keys
from damian.advice.fleet import Fleet
from damian.advice.ground import Ground
from damian.advice.node import Node
from damian.advice.reports import Report, json_rows, read_rows
from damian.envs.pipeline import make_env
from damian.envs.scenario import ScenarioConfig

START = 1.7e9
"""When the simulated flights begin [s since 1970]."""


def names_of(n: int) -> list[str]:
    return [f"uav-{i}" for i in range(n)]


class Reporter:
    """What the UAVs of a simulated world say, as rows of JSON.

    Args:
        env: environment with the extra ``message``, of a single world.
        ground: landing points of the service.
        fraction: share of a step after its beginning at which messages are generated.
    """

    def __init__(self, env, ground: Ground, fraction: float = 0.0, start: float = START) -> None:
        self.env, self.ground, self.fraction, self.start = env, ground, fraction, start
        self.dt = env.uav_env.scenario.clock.dt
        self.points = env.uav_env.simulation.airspace.points[0]
        self.in_transit: list[tuple[int, int, dict[str, Any]]] = []

    def number_at(self, xy: torch.Tensor) -> int:
        return int((self.points - xy).square().sum(-1).argmin())

    def time_of(self, step: float) -> float:
        return self.start + (step + self.fraction) * self.dt

    def row(self, messages, uav: int, step: int) -> dict[str, Any]:
        """What one UAV says in a step."""

        def place(xy) -> tuple[float, float]:
            return self.ground.place(self.number_at(xy))

        at, bound = place(messages.position[uav]), place(messages.target[uav])
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
            "sequence": step,
        }
        seen = float(messages.detected_time[uav])
        if seen >= 0:
            there = place(messages.detected_position[uav])
            row |= {"source time": self.time_of(round(seen / self.dt))}
            row |= {f"source {first}": there[0], f"source {second}": there[1]}
        return row

    def send(self, outputs, step: int, at_once: bool = False) -> None:
        """Send what the UAVs say after a step, with the delays that the simulation has drawn."""
        messages = self.env.server.messages(outputs[keys.MESSAGE])
        one = type(messages)._make(field[0] for field in messages)
        for uav in range(one.time.shape[0]):
            delay = 0 if at_once or keys.DELAY not in outputs.keys(True) else int(outputs[keys.DELAY][0, uav])
            if delay >= 0 and (at_once or outputs[keys.MESSAGE_SENT][0, uav]):
                self.in_transit.append((step + delay, uav, self.row(one, uav, step)))

    def arriving(self, step: int) -> list[dict[str, Any]]:
        """The rows that arrive in a step, in any order."""
        here = [row for due, _, row in self.in_transit if due == step]
        self.in_transit = [each for each in self.in_transit if each[0] != step]
        return here[::-1]


def as_reports(rows: Sequence[dict[str, Any]], now: float) -> list[Report]:
    """Rows as the service reads them from JSON."""
    return read_rows(json_rows(json.dumps(list(rows))), now, file=False) if rows else []


def flights(
    scenario: ScenarioConfig, policy_of, n_steps: int, seed: int = 3, fraction: float = 0.0, **options: Any
) -> Iterator[tuple[Any, Fleet, torch.Tensor, list[int], int]]:
    """Fly a simulated world by a policy, and let a fleet follow by what the UAVs report.

    Yields:
        What the simulation shows the policy, the fleet, the policy's action, the numbers of the UAVs that
        choose, and the step.
    """
    env = make_env(scenario, 1, seed, extras=["message"])
    node = Node(scenario, seed)
    policy = policy_of(env)
    fleet = Fleet(node, names_of(scenario.agents), policy_of(node.env), **options)
    reporter = Reporter(env, fleet.ground, fraction)
    shown = env.reset()
    reporter.send(shown, 0, at_once=True)
    for step in range(n_steps):
        now = reporter.time_of(step) + 0.2 * reporter.dt
        for report in as_reports(reporter.arriving(step), now):
            fleet.check(report, now)
            fleet.report(report, now)
        fleet.advance(now + 0.1)
        acted = policy(shown.clone())
        ready = shown[keys.READY][0].nonzero().flatten().tolist()
        yield shown, fleet, acted[keys.ACTION], ready, step
        shown = env.step(acted)["next"]
        reporter.send(shown, step + 1)
