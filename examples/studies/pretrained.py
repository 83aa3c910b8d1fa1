"""Make the policies of the package, ``damian/data/NAME``, each with a card (docs/policies.md).

    python examples/studies/pretrained.py      (two hours; finished runs are taken)
    python examples/studies/pretrained.py convoy --runs runs/pretrained
    python examples/studies/pretrained.py crowded --fly delay.obs=1..7 --agents 3 --planner

The last one trains nothing: it flies policies of the package over the outlines, with settings of
the user's own, and prints the table.

A policy is a run folder of plain data: ``checkpoint.pt`` holds the actor's weights in half
precision, ``config.yaml`` the settings, ``result.csv`` what it returns over outlines that no
training has seen, and ``README.md`` is its card.
"""

import json
import math
import shlex
import subprocess
import sys
import time
from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd
import torch
import yaml
from scipy.special import stdtrit
from tensordict.nn import TensorDictModule
from tqdm import tqdm

import damian
from damian.baselines.planner import planner_policy
from damian.baselines.script import script_policy
from damian.common.fields import nested
from damian.common.tables import markdown_table, write_csv
from damian.envs.delayed_env import DelayedEnv
from damian.recipes import cli
from damian.recipes.shared.runs import run_settings
from damian.runs.checkpoint import read_checkpoint, write_checkpoint
from damian.runs.metrics import evaluate


class Packaged(NamedTuple):
    """A policy of the package."""

    words: str
    """The words after ``damian train`` that train it."""
    limits: str
    """What it is good for."""
    flown: tuple[str, ...] = ()
    """Settings that it flies with, if not with those of its training."""


FORWARD = ("delay.obs=0..7", "observation.own=true", "observation.forward=policy")
"""What is late is flown forward by a model of the world."""
ANYWHERE = "region=random region.pool=256 region.max_area=300000 agents=5 seed=0"
LATE = "aware=timeline delay.obs=0..7"
REGIONS = "Two to eight UAVs in regions of 0.1 to 0.3 km²"
POLICIES = {
    "crowded": Packaged(
        f"scenario=tasks/crowded_five observation.advice=true {ANYWHERE} frames=800000",
        f"{REGIONS}, at their targets at once; footprints of 71 m.",
        FORWARD,
    ),
    "flights": Packaged(
        f"scenario=tasks/flights source.level_db=142 {ANYWHERE} frames=800000",
        f"{REGIONS}, flights at up to 20 m/s; footprints of 71 m.",
        FORWARD,
    ),
    "convoy": Packaged(
        "scenario=convoy model=sets observation.actions=true motion.max_speed=15 "
        '"observation.global_features=[detections,others]" '
        '"observation.local_features=[spotted,place,number]" learner.team=1.0 '
        "learner.anneal=true learner.epochs=4 learner.entropy_coeff=0.01 "
        f"{LATE} {ANYWHERE} worlds=256 frames=800000",
        f"{REGIONS}, all of 15 m/s, after two sources; footprints of 45 m.",
    ),
    "tracking": Packaged(
        f"scenario=tasks/tracking {LATE} {ANYWHERE} frames=1000000",
        f"{REGIONS}, at their targets at once, after one fast source; footprints of 32 m.",
    ),
}
"""The policies, by name."""
OUTLINES = Path(__file__).parents[2] / "tests" / "data" / "regions" / "outlines.geojson"
"""Ten areas of 0.12 to 0.28 km² in the shape of countries (Natural Earth, public domain), with
holes in four of them."""
FLEETS = (3, 5, 8)
"""Numbers of UAVs that fly over the outlines."""
EPISODES = 10
"""Episodes over each outline."""
SEED = 20_000
"""The seed of these episodes."""
TIMED = 40
"""Steps of which the mean time is told."""


def over_outlines(
    run: str,
    settings: Sequence[str] = (),
    fleets: Sequence[int] = FLEETS,
    planner: bool = False,
) -> pd.DataFrame:
    """True returns of a policy over outlines that no training has seen, beside scripts in the same
    episodes.

    A line for each number of UAVs and outline: mean returns of sampled and of most likely actions,
    of the script on the same late messages, and of the script flown forward; with ``planner`` also
    of the planner on what is flown forward.

    Args:
        run: folder of a run, or the name of a policy of the package.
        settings: with which all fly, if not with those of the policy.
        fleets: numbers of UAVs.
        planner: whether it flies, too.
    """
    outlines = json.loads(OUTLINES.read_text(encoding="utf-8"))["features"]
    places = [(n, each["properties"]["name"]) for n in fleets for each in outlines]
    lines = []
    for agents, outline in tqdm(places, run):
        words = [f"region={OUTLINES}", f"region.where=name:{outline}", f"agents={agents}"]
        flights = made_flights(run, [*words, *settings], EPISODES, planner)
        line: dict[str, object] = {"agents": agents, "outline": outline}
        for kind, (env, policy) in flights.items():
            env.set_seed(SEED)
            horizon = env.uav_env.scenario.episode.max_steps or 0
            line[kind] = evaluate(env, policy, horizon, sample=kind == "sampled")["return"]
        lines.append(line)
    return pd.DataFrame(lines)


def made_flights(
    run: str, words: Sequence[str], worlds: int, planner: bool
) -> dict[str, tuple[DelayedEnv, TensorDictModule]]:
    """What flies, by name: the policy of a run, sampled and most likely, and its rivals."""
    ahead = ["observation.own=true", "observation.forward=script"]
    policy, env = damian.load(run, *words, num_worlds=worlds, seed=SEED)
    late, forward = (
        damian.load(run, *words, *changed, num_worlds=worlds, seed=SEED).env
        for changed in (["observation.forward=null"], ahead)
    )
    flights = {
        "sampled": (env, policy),
        "most likely": (env, policy),
        "script": (late, script_policy(late)),
        "script+forward": (forward, script_policy(forward)),
    }
    if planner:
        flights["planner"] = (forward, planner_policy(forward, compile=True))
    return flights


def milliseconds(run: str, settings: Sequence[str], agents: int) -> dict[str, float]:
    """Processor time of a step of one world [ms], the decision and the simulation of late messages
    included, by what flies."""
    found = {}
    flights = made_flights(run, [*settings, f"agents={agents}"], 1, planner=True)
    for kind, (env, policy) in flights.items():
        env.rollout(5, policy, break_when_any_done=False)
        began = time.process_time()
        env.rollout(TIMED, policy, break_when_any_done=False)
        found[kind] = 1e3 * (time.process_time() - began) / TIMED
    return found


def differences(lines: pd.DataFrame) -> pd.DataFrame:
    """For each number of UAVs: mean returns over outlines, and how much more the most likely actions
    return than the script on the same messages, with a 95 % interval over outlines."""
    known = lines.drop(columns="outline").groupby("agents").mean()
    won = (lines["most likely"] - lines["script"]).groupby(lines["agents"])
    n = won.count()
    half = won.std() / n**0.5 * [float(stdtrit(each - 1, 0.975)) for each in n]
    return known.assign(difference=won.mean(), low=won.mean() - half, high=won.mean() + half)


def ship(name: str, run: Path) -> None:
    """Store the policy of a run in the package, fly it, and write its card."""
    folder = Path(damian.__file__).parent / "data" / name
    policy = POLICIES[name]
    folder.mkdir(exist_ok=True)
    actor = read_checkpoint(run / "checkpoint.pt", "checkpoint")["components"]["actor"]
    half = {
        key: each.half() if isinstance(each, torch.Tensor) else each for key, each in actor.items()
    }
    write_checkpoint(folder / "checkpoint.pt", {"components": {"actor": half}})
    words = [f"checkpoint='{run}'", *policy.flown]
    with run_settings(cli.composed(*words), words) as config:
        settings = nested(config) | {"checkpoint": None}
    (folder / "config.yaml").write_text(yaml.safe_dump(settings, sort_keys=False), encoding="utf-8")
    write_csv(folder / "result.csv", over_outlines(f"damian:{name}", planner=True).round(3))
    (folder / "README.md").write_text(card(name, run), encoding="utf-8")


def card(name: str, run: Path) -> str:
    """The card of a policy."""
    policy = POLICIES[name]
    record = json.loads((run / "run.json").read_text(encoding="utf-8"))
    data = "without delay" if policy.flown else "from late data only"
    flown = "Its settings for flights: `" + " ".join(policy.flown) + "`.\n\n"
    return f"""# {name}

`policy, env = damian.load("damian:{name}")`

**Limits.** {policy.limits}

**Trained** {data}, by damian {record["damian"]}, commit {record["commit"][:7]}:

```bash
damian train {policy.words} compile=true
```

{flown * bool(policy.flown)}[docs/policies.md](../../../docs/policies.md) lists its returns.
"""


def written(mean: float) -> str:
    """A mean return in a table, "-" if it was not measured."""
    return "-" if math.isnan(mean) else f"{mean:.1f}"


def table(lines: pd.DataFrame) -> str:
    """Mean returns over outlines, for each number of UAVs."""
    kinds = [*lines.columns.drop(["agents", "outline"])]
    rows = [
        [
            f"{agents}",
            *(written(line[kind]) for kind in kinds),
            f"{line['difference']:.1f} [{line['low']:.1f}, {line['high']:.1f}]",
        ]
        for agents, line in differences(lines).iterrows()
    ]
    return markdown_table(["UAVs", *kinds, "difference"], rows)


def main(words: list[str] | None = None) -> None:
    """Train what has not been trained, and store it."""
    parser = ArgumentParser(description="Make the policies of the package.")
    parser.add_argument("names", nargs="*", default=[*POLICIES], help="policies to make")
    parser.add_argument(
        "--runs", type=Path, default=Path("runs/pretrained"), help="folder of the runs"
    )
    parser.add_argument("--fly", nargs="+", metavar="KEY=VALUE", help="settings to fly with")
    parser.add_argument("--agents", nargs="+", type=int, default=FLEETS, help="with --fly")
    parser.add_argument("--planner", action="store_true", help="with --fly: beside the planner")
    args = parser.parse_args(words)
    torch.set_num_threads(1)
    for name in args.names:
        if args.fly:
            lines = over_outlines(f"damian:{name}", args.fly, args.agents, args.planner)
            print(f"{name}\n\n{table(lines)}\n")
            times = milliseconds(f"damian:{name}", args.fly, args.agents[0])
            told = ", ".join(f"{kind} {ms:.0f}" for kind, ms in times.items())
            print(f"processor time of a step with {args.agents[0]} UAVs [ms]: {told}")
            continue
        run = args.runs / name
        if not (run / "result.csv").exists():
            command = [
                Path(sys.executable).with_name("damian"),
                "train",
                *shlex.split(POLICIES[name].words),
            ]
            subprocess.run([*command, "compile=true", f"hydra.run.dir={run}"], check=True)
        ship(name, run)


if __name__ == "__main__":
    main()
