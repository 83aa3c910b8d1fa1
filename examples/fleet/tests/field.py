"""Fleets for tests: one whose policy does as it is told, and one that follows a simulation."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from reports import LLANBEDR, START, Reporter, names_of, read_json

from damian import keys
from damian.envs.config import ScenarioConfig
from damian.envs.pipeline import make_env
from damian.server.config import EpisodeConfig, ObservationConfig
from damian.world.config import ActionConfig, MotionConfig, SourceConfig
from damian_fleet.fleet import Fleet
from damian_fleet.node import Node, for_uavs
from damian_fleet.rows import Acknowledgement, Asking, Change, Command
from damian_fleet.settings import FleetConfig
from damian_fleet.store import Fleets

EAST = 0
WEST = 1
FEATURES = [
    "source_distance",
    "source_bearing",
    "source_time",
    "source_drift",
    "agent_distances",
    "coverage",
]
SEEN = ObservationConfig(global_features=FEATURES, local_features=["spotted", "battery"], age=True)
FLIGHTS = MotionConfig(kind="polynomial", max_speed=20.0, max_acceleration=10.0)
WALK = SourceConfig(motion="dynamic", level_db=143.0, emission="per_step", emission_probability=0.6)


def scenario_of(**changed: Any) -> ScenarioConfig:
    endless = {
        "episode": EpisodeConfig(max_steps=None),
        "region": LLANBEDR,
        "source": WALK,
        "agents": 3,
    }
    return ScenarioConfig(**{**endless, "observation": SEEN, **changed})


SCENARIO = scenario_of(
    motion=FLIGHTS, actions=ActionConfig(distances=[60.0], headings=[90.0, -90.0])
)

NODES: dict[tuple[str, int], Node] = {}
"""Nodes that tests share, by scenario and number of UAVs; they remember nothing of a fleet."""


class Field:
    """A fleet in a database, whose policy sends UAV ``i`` by ``wishes[i]`` unless ``policy_of``
    makes one."""

    def __init__(
        self,
        path: str | Path = ":memory:",
        uavs="AB",
        scenario=SCENARIO,
        policy_of=None,
        **rules: Any,
    ) -> None:
        self.wishes = [EAST] * 4
        self.now = START
        self.scenario = scenario
        self.policy_of = policy_of
        self.path = path
        self.rules = FleetConfig(**rules)
        self.fleets = self.open()
        self.fleets.create("north", [*uavs])

    def open(self) -> Fleets:
        return Fleets(self.make, self.path, {"policy": "script"})

    def restart(self) -> None:
        self.fleets.close()
        self.fleets = self.open()

    def parts(self, n: int) -> tuple[Node, Any]:
        if (key := (repr(self.scenario), n)) not in NODES:
            NODES[key] = Node(for_uavs(self.scenario, n), 3)
        return NODES[key], self.policy_of(NODES[key].env) if self.policy_of else self.wish

    def make(self, uavs: list[str], mark: str, latest: float) -> Fleet:
        return Fleet(self.parts, uavs, self.rules, mark, latest - 1000)

    def wish(self, read):
        n = read[keys.ACTION_MASK].shape[1]
        return read.set(keys.ACTION, torch.tensor([self.wishes[:n]]))

    @property
    def fleet(self) -> Fleet:
        return self.fleets["north"]

    def report(self, uav: str, point: int, **said: Any) -> list[str]:
        lat, lon = self.fleet.ground.place(point)
        row = {"ID": uav, "time": self.now, "lat": lat, "lon": lon, "battery": 90.0} | said
        return self.send(row)

    def take(self, request, said: Any) -> list[str]:
        return self.fleets.take("north", request, said, self.now)

    def send(self, *rows: dict[str, Any]) -> list[str]:
        return self.take(Fleet.reported, read_json(rows))

    def ask(self, uav: str, after: float = 0.0):
        self.now += after
        return self.ask_all([uav])[0]

    def ask_all(self, uavs: list[str]):
        self.take(Fleet.advised, Asking(uavs=uavs))
        return self.fleet.advice(Asking(uavs=uavs))

    def say(self, uav: str, answer: str | None, status: str, after: float = 0.0) -> str:
        self.now += after
        return self.take(
            Fleet.acknowledged, [Acknowledgement(ID=uav, answer=answer or "", status=status)]
        )[0]

    def command(self, command: str, uavs: list[str] | None) -> list[str]:
        return self.take(Fleet.commanded, Command(command=command, uavs=uavs))

    def change(self, join: list[str], leave: list[str]) -> list[str]:
        return self.take(Fleet.changed, Change(join=join, leave=leave))

    def booked(self, uav: str) -> int:
        return self.fleet._standing(uav, False)

    def east_of(self, point: int) -> int:
        """Where the policy sends a UAV from a landing point."""
        return int(self.fleet.node.simulation.candidates.goals()[0, point, EAST])


def flights(
    scenario: ScenarioConfig, policy_of, n_steps: int, fraction: float = 0.0
) -> Iterator[tuple]:
    """Fly a simulated world by a policy, and let a fleet follow by what the UAVs report.

    Yields:
        What the simulation shows the policy, the field, the policy's action, the IDs of the UAVs
        that choose, and the step.
    """
    env = make_env(scenario, 1, 3, extras=["message"])
    policy = policy_of(env)
    uavs = names_of(scenario.agents)
    field = Field(
        ":memory:", uavs, scenario, policy_of, reserve=0.0, oldest_report=1e6, clearance=0.0
    )
    field.fleet._bends = lambda _: False  # UAVs of a simulation fly around
    reporter = Reporter(env, field.fleet.ground, fraction)
    shown = env.reset()
    reporter.send(shown, 0, at_once=True)
    for step in range(n_steps):
        field.now = reporter.time_of(step) + 0.2 * reporter.dt
        if rows := reporter.arriving(step):
            field.send(*rows)
        acted = policy(shown.clone())
        ready = [uavs[i] for i in shown[keys.READY][0].nonzero().flatten().tolist()]
        for uav in ready:
            if order := field.fleet.uavs[uav].open_order:
                field.say(uav, order.advice["answer"], "landed")
        field.fleet.advance(field.now)
        yield shown, field, acted[keys.ACTION], ready, step
        shown = env.step(acted)["next"]
        reporter.send(shown, step + 1)
