"""UAVs of a simulation that report as real ones would, late, out of order and with losses."""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase

from damian import keys
from damian.envs.config import ScenarioConfig
from damian.envs.pipeline import make_env
from damian.field.known import Ground
from damian.field.node import Node
from damian.field.rows import Report, Rows, reports_of, rows_of_json
from damian_fleet.fleet import Fleet
from damian_fleet.rules import FieldRules

START = 1.7e9
"""When the simulated flights begin [s since 1970]."""
FREE = FieldRules(acknowledge=False, reserve=0.0, oldest_report=1e6)
"""Rules that let UAVs do whatever the policy chooses, as in a simulation."""


def names_of(n: int) -> list[str]:
    return [f"uav-{i}" for i in range(n)]


class Reporter:
    """What the UAVs of a simulated world say, as rows of JSON.

    Args:
        env: environment with the extra ``message``.
        ground: landing points of the service.
        fraction: share of a step after its beginning at which messages are generated.
        start: when the flight begins [s].
        world: number of the world.
    """

    def __init__(
        self, env, ground: Ground, fraction: float = 0.0, start: float = START, world: int = 0
    ) -> None:
        self.env, self.ground, self.fraction, self.start, self.world = env, ground, fraction, start, world
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
            "sequence": self.n_sent[uav],
            "landed": [self.time_of(round(t / self.dt)) for t in messages.landed[uav].tolist() if t >= 0],
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
        one = type(messages)._make(field[self.world] for field in messages)
        for uav in range(one.time.shape[0]):
            known = at_once or keys.DELAY not in outputs.keys(True)
            delay = 0 if known else int(outputs[keys.DELAY][self.world, uav])
            sent = at_once or bool(outputs[keys.MESSAGE_SENT][self.world, uav])
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


def as_reports(rows: Sequence[dict[str, Any]], now: float) -> list[Report]:
    """The reports of rows that come in now."""
    reports = [report for _, report in read_json(list(rows))] if rows else []
    for report in reports:
        report.stamp(now)
    return reports


def advise(fleet: Fleet, now: float, asking: Sequence[str] | None = None) -> list[int]:
    """Let UAVs choose, and tell them; returns the numbers of those that have chosen."""
    choice = fleet.choose(now, asking)
    if choice is None:
        return []
    fleet.tell(choice)
    return [*choice.decisions]


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
    fleet = Fleet(node, names_of(scenario.agents), policy_of(node.env), rules=FREE, **options)
    reporter = Reporter(env, fleet.ground, fraction)
    shown = env.reset()
    reporter.send(shown, 0, at_once=True)
    for step in range(n_steps):
        now = reporter.time_of(step) + 0.2 * reporter.dt
        for report in as_reports(reporter.arriving(step), now):
            fleet.check(report)
            fleet.report(report)
        fleet.advance(now + 0.1)
        acted = policy(shown.clone())
        ready = shown[keys.READY][0].nonzero().flatten().tolist()
        yield shown, fleet, acted[keys.ACTION], ready, step
        shown = env.step(acted)["next"]
        reporter.send(shown, step + 1)


class Client(TensorDictModuleBase):
    """A policy for ``damian.runs.metrics.evaluate`` that asks a service, with a fleet for each world.

    It knows nothing but what the service answers: the places to which it sends the UAVs.

    Args:
        env: environment of B worlds with continuous actions and the extra ``message``.
        ground: landing points of the service.
        http: client of the service, with the token of the service.
        wait: sets the clock to an instant, or waits until it has come.
        start: when the flights begin [s].
    """

    def __init__(self, env, ground: Ground, http, wait: Callable[[float], None], start: float) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [keys.MESSAGE], [keys.ACTION]
        self.goals = lambda: env.uav_env.state.goal
        self.ground, self.http, self.wait, self.start = ground, http, wait, start
        n_worlds, self.n = env.batch_size[0], env.uav_env.n_agents
        self.reporters = [Reporter(env, ground, start=start, world=world) for world in range(n_worlds)]
        for world in range(n_worlds):
            made = http.put(f"/fleets/f{world}", json={"uavs": names_of(self.n)})
            assert made.status_code in (200, 201), made.text
        self.step = 0

    def forward(self, outputs):
        one = self.reporters[0]
        self.wait(one.time_of(self.step) + 0.1 * one.dt)
        actions = [self.advised(reporter, outputs) for reporter in self.reporters]
        self.step += 1
        return outputs.set(keys.ACTION, torch.stack(actions))

    def advised(self, reporter: Reporter, outputs) -> torch.Tensor:
        """Actions of the UAVs of a world, from what the service answers."""
        reporter.send(outputs, self.step, at_once=self.step == 0)
        path, rows = f"/fleets/f{reporter.world}", reporter.arriving(self.step)
        if rows:
            answer = self.http.post(f"{path}/reports", json=rows)
            assert answer.status_code == 200, answer.text
        ready = outputs[keys.READY][reporter.world].nonzero().flatten().tolist()
        action = torch.zeros(self.n, 2)
        if not ready:
            return action
        asked = "&".join(f"uav={names_of(self.n)[uav]}" for uav in ready)
        answer = self.http.get(f"{path}/advice?{asked}")
        assert answer.status_code == 200, answer.text
        standing = self.goals()[reporter.world] % len(reporter.points)
        for uav, told in zip(ready, answer.json()["advice"], strict=True):
            goal = self.ground.landing_point(tuple(told[column] for column in self.ground.columns))
            way = reporter.points[goal] - reporter.points[standing[uav]]
            turn = torch.atan2(way[0], way[1]) / (2 * math.pi)
            action[uav] = torch.stack([way.norm() / FARTHEST, turn % 1.0])
        return action


FARTHEST = 400.0
"""Longest flight of a UAV of a ``Client`` [m]: farther than any action of the policies leads."""


def flown_by_clients(scenario: ScenarioConfig) -> ScenarioConfig:
    """The scenario for the UAVs of a ``Client``, which fly to any place that they are told."""
    actions = replace(scenario.actions, kind="continuous", distances=[0.0, FARTHEST])
    observation = replace(scenario.observation, belief=[])
    return replace(scenario, actions=actions, observation=observation)
