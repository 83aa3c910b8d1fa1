"""What a policy brings in the simulator, and by service, bridge and simulated copters.

    python -m damian_fleet.mavlink.transfer runs/FOLDER --journals runs/flown --wind 4,2 --gusts 1.5 \
        --delay 0.1,0.8 --loss 0.1

Each episode begins on the same landing points in both. The return is computed by the reward functions of the
run from where the UAVs truly were, as ``damian evaluate`` does. The journals and a table of all reports, for
``damian advise fit=``, lie in the folder ``--journals``.
"""

import argparse
import csv
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from scipy.stats import t as student
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

import damian
from damian import keys
from damian.baselines.script import script_policy
from damian.field.fitting import read_log
from damian.field.known import UavLog, messages_of
from damian.field.node import Node, for_uavs
from damian.field.rows import Report, validated
from damian_fleet.fleet import Fleet
from damian_fleet.mavlink.lockstep import BEGIN, Lockstep
from damian_fleet.mavlink.vehicles import Airframe, Radio, Weather
from damian_fleet.rules import FieldRules
from damian_fleet.session import AdviceSession

POLICIES = ("trained", "trained, deterministic", "script")
SEED = 10_000
"""Seed of the first landing points, as of an evaluation of a training of seed 0."""


def policy_of(name: str, trained: Any, env: Any) -> Any:
    """A policy for an environment; that of the run draws its actions, unless it is deterministic."""
    return script_policy(env) if name == "script" else trained


def simulated(name: str, trained: Any, env: Any, horizon: int) -> Tensor:
    """True returns of a policy in the simulator, one for each world."""
    env.set_seed(SEED)
    torch.manual_seed(SEED)
    kind = ExplorationType.DETERMINISTIC if name.endswith("deterministic") else ExplorationType.RANDOM
    with torch.no_grad(), set_exploration_type(kind):
        rollout = env.rollout(horizon, policy_of(name, trained, env), break_when_any_done=False)
    elapsed = torch.arange(1, rollout.shape[1] + 1).expand(rollout.shape)
    truth = env.server(env.server.messages(rollout["next", keys.MESSAGE]), elapsed, None)
    return truth.reward.mean(-1).sum(-1)


class Truth:
    """The messages that the UAVs would have sent in the simulator, had it flown them so, and their return."""

    def __init__(self, node: Node, flying: Lockstep) -> None:
        self.node, self.flying = node, flying
        n_stops = node.server.observation.stops
        self.logs = [UavLog(node.ground, n_stops, 0, node.dt) for _ in flying.copters]
        self.steps: list[Any] = []
        self.note()

    def note(self) -> None:
        """Note where the UAVs stand, or from where they have taken off since the step before."""
        step, dt, flying = len(self.steps), self.node.dt, self.flying
        for log, copter, bridge in zip(self.logs, flying.copters, flying.bridges, strict=True):
            stops, at = [*bridge.stops], copter.place()
            if log.newest and not copter.landed and copter.took_off <= flying.now - dt:
                continue  # it is silent in flight
            if copter.landed and len(copter.flights) == len(bridge.flights):
                del stops[:1]  # the bridge knows that it has landed here
            row = {"ID": bridge.uav, "time": flying.now, "previous": stops}
            if not copter.landed:
                at, goal = copter.start, bridge.goal
                target = (goal.lat, goal.lon) if goal else at
                row |= {"FLA": 1.0, "previous": stops[1:], "target lat": target[0], "target lon": target[1]}
            log.add(validated(Report, row | {"lat": at[0], "lon": at[1]}), step, None)
        held = [log.newest for log in self.logs]
        points = self.node.simulation.airspace.points[0]
        self.steps.append(messages_of(held, self.node.server, points, dt))

    def total(self) -> float:
        """The return."""
        messages = [torch.stack(field) for field in zip(*self.steps[1:], strict=True)]
        elapsed = torch.arange(1, len(self.steps))
        return float(
            self.node.server(type(self.steps[0])._make(messages), elapsed, None).reward.mean(-1).sum()
        )


def flown(
    name: str,
    given: argparse.Namespace,
    trained: Any,
    scenario: damian.ScenarioConfig,
    starts: Sequence[Sequence[int]],
    folder: Path,
    **copter: Any,
) -> tuple[Tensor, list[Any]]:
    """True returns of episodes that begin on landing points, by the numbers of these; and their flights."""
    node = Node(for_uavs(scenario, scenario.agents))
    policy, drawn, rules = policy_of(name, trained, node.env), name == "trained", FieldRules()
    returns: list[float] = []
    flights: list[Any] = []
    about = {"policy": name, "checkpoint": given.run}
    for number, points in enumerate(starts):

        def make(uavs: list[str], mark: str, seed: int = number) -> Fleet:
            return Fleet(node, uavs, policy, drawn, seed, rules, mark=mark)

        session = AdviceSession(make, folder / f"{number}", about)
        places = {f"uav{i}": node.ground.place(point) for i, point in enumerate(points)}
        flying = Lockstep(session, places, f"flight{number}", BEGIN + 1e4 * number, seed=number, **copter)
        truth = Truth(node, flying)
        for _ in range(given.steps):
            flying.run(node.dt)
            truth.note()
        returns.append(truth.total())
        flights += [flight for bridge in flying.bridges for flight in bridge.flights]
        flying.close()
    return torch.tensor(returns), flights


def write_reports(folder: Path) -> Path:
    """All reports of the journals as a table with the times when they came in, for ``damian advise fit``."""
    rows = []
    for path in sorted(folder.glob("*/*.jsonl")):
        for report in read_log(path):
            own = f"{path.stem}-{report.id}", f"{report.time:.6f}", f"{report.received:.6f}"
            rows.append([*own, report.lat, report.lon, report.fla, report.sequence])
    table = folder / "reports.csv"
    with table.open("w", encoding="utf-8", newline="") as file:
        head = ["ID", "time", "receive time", "lat", "lon", "FLA", "sequence"]
        csv.writer(file).writerows([head, *rows])
    return table


def mean(values: Tensor) -> str:
    """A mean with its 95 % interval, by Student's t."""
    half = student.ppf(0.975, len(values) - 1) * float(values.std()) / math.sqrt(len(values))
    return (
        f"{float(values.mean()):.2f} [{float(values.mean()) - half:.2f}, {float(values.mean()) + half:.2f}]"
    )


def main() -> None:
    """Print a row for each policy."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", help="run folder of the trained policy")
    parser.add_argument("--episodes", type=int, default=30)
    parser.add_argument("--steps", type=int, help="of an episode; those of the run if not given")
    parser.add_argument("--policies", default=";".join(POLICIES), help="; between them")
    parser.add_argument("--wind", default="0,0", help="EAST,NORTH [m/s]")
    parser.add_argument("--gusts", type=float, default=0.0, help="standard deviation [m/s]")
    parser.add_argument("--delay", default="0,0", help="LOW,HIGH of the radio, each way [s]")
    parser.add_argument("--loss", type=float, default=0.0, help="probability that a message is lost")
    parser.add_argument("--acceleration", type=float, default=3.0, help="of the copters [m/s^2]")
    parser.add_argument("--journals", type=Path, required=True, help="a new folder")
    given = parser.parse_args()
    torch.set_num_threads(1)
    loaded = damian.load(given.run)
    scenario = loaded.env.uav_env.scenario
    given.steps = given.steps or scenario.episode.max_steps or 200
    env = damian.make_env(scenario, given.episodes, SEED, extras=["message"])
    at = env.server.messages(env.reset()[keys.MESSAGE]).position
    starts = torch.cdist(at, env.uav_env.simulation.airspace.points[0]).argmin(-1).tolist()
    wind, delay = (list(map(float, text.split(","))) for text in (given.wind, given.delay))
    world = {"weather": Weather(*wind, given.gusts), "radio": Radio(*delay, given.loss)}
    world["airframe"] = Airframe(acceleration=given.acceleration)
    print("| policy | simulator | flown | flown less simulated | flights | time taken / said | s/episode |")
    print("|:--|--:|--:|--:|--:|--:|--:|", flush=True)
    for name in given.policies.split(";"):
        folder, began = given.journals / name.replace(", ", "_"), time.monotonic()
        expected = simulated(name, loaded.policy, env, given.steps)
        returns, flights = flown(name, given, loaded.policy, scenario, starts, folder, **world)
        ratio = sum(each.time for each in flights) / max(sum(each.said_time for each in flights), 1e-9)
        aborted = sum(each.end == "aborted" for each in flights)
        n = f"{len(flights) / given.episodes:.1f}" + f" ({aborted} aborted)" * bool(aborted)
        cells = [name, mean(expected), mean(returns), mean(returns - expected), n, f"{ratio:.2f}"]
        spent = (time.monotonic() - began) / given.episodes
        print(f"| {' | '.join(cells)} | {spent:.1f} |", flush=True)
        print(f"reports: {write_reports(folder)}", file=sys.stderr)


if __name__ == "__main__":
    main()
