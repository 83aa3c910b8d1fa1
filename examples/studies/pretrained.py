"""Make the policies of the package, ``damian/data/NAME``, each with a card (docs/policies.md).

    python examples/studies/pretrained.py      (three hours on one core; finished runs are taken)
    python examples/studies/pretrained.py requests --runs runs/pretrained

A policy is a run folder of plain data: ``checkpoint.pt`` holds the actor's weights in half
precision, ``config.yaml`` the settings, ``result.csv`` and the card ``README.md`` what it returns
under which delays.
"""

import json
import math
import shlex
import subprocess
import sys
from argparse import ArgumentParser
from pathlib import Path

import pandas as pd
import torch
import yaml
from scipy.special import stdtrit

import damian
from damian.baselines.random import random_policy
from damian.baselines.script import script_policy
from damian.common.fields import nested
from damian.common.tables import markdown_table, write_csv
from damian.recipes.known import CONF
from damian.recipes.shared.runs import stored_config
from damian.runs.checkpoint import read_checkpoint, write_checkpoint
from damian.runs.metrics import evaluate

POLICIES = {
    "crowded-any-delay": (
        "scenario=delaybench/crowded aware=timeline model=gru seed=0 "
        '"delay.obs={law: lag, lag: {law: uniform, low: 1, high: 7}, update_period: episode}"',
        "Three UAVs that are at their targets at once, in regions of 0.1 to 0.2 km²; footprints of "
        "100 m.",
    ),
    "flights": (
        "scenario=delaybench/crowded motion=polynomial aware=timeline delay.obs=1..7 seed=10",
        "As crowded-any-delay, but flights take time (20 m/s), and nothing is remembered.",
    ),
    "requests": (
        "scenario=requests aware=timeline delay.obs=1..7 seed=0",
        "Three UAVs that are at their targets at once, in regions of 0.3 to 0.6 km², with 30 "
        "requests a "
        "minute, at most six of them open at once.",
    ),
    "convoy": (
        "scenario=convoy frames=600000 aware=timeline model=gru delay.obs=1..7 seed=0",
        "UAVs of 10, 15 and 20 m/s that follow two sources in the paper's polygon, and no other "
        "region.",
    ),
    "tracking": (
        "scenario=delaybench/tracking frames=600000 aware=belief delay.obs=1..7 seed=0",
        "Three UAVs that are at their targets at once, after one fast source in the paper's "
        "polygon, and in "
        "no other region. The filter, which knows how the source moves, does nearly all: "
        "untrained, 19.5.",
    ),
}
"""What each policy is trained with, and for what it is good."""
LAWS = {
    "as trained": (),
    "no delay": ("delay.obs=0",),
    "1 to 7 steps": ("delay.obs=1..7",),
    "4 steps": ("delay.obs=4",),
    "8 steps": ("delay.obs=8",),
    "the paper's": ("delay=paper",),
    "bursts": ("delay=burst",),
}
"""Delays under which each is flown."""
BATCHES, WORLDS, SEED = 5, 200, 20_000
"""Batches of episodes, each over regions of its own, and the seed of the first."""
OUTLINES = Path(__file__).parents[2] / "tests" / "data" / "regions" / "outlines.geojson"
"""Ten areas of 0.12 to 0.28 km² in the shape of countries (Natural Earth, public domain), with
holes in four of them."""
FLEETS = (3, 5, 8)
"""Numbers of UAVs that fly over the outlines."""
EPISODES = 20
"""Episodes over each outline."""


def over_outlines(name: str) -> pd.DataFrame:
    """True returns over outlines that no training has seen, beside scripts in the same episodes.

    A line for each outline and number of UAVs: mean returns of the policy (sampled, and most likely
    actions), of the script on the same late messages, and of the script flown forward.
    """
    outlines = json.loads(OUTLINES.read_text(encoding="utf-8"))["features"]
    lines = []
    for agents in FLEETS:
        for outline in (feature["properties"]["name"] for feature in outlines):
            words = [f"region={OUTLINES}", f"region.where=name:{outline}", f"agents={agents}"]
            policy, env = damian.load(f"damian:{name}", *words, num_worlds=EPISODES, seed=SEED)
            forward = damian.load(
                f"damian:{name}",
                *words,
                "observation.own=true",
                "observation.forward=script",
                num_worlds=EPISODES,
                seed=SEED,
            ).env
            flights = {
                "sampled": (env, policy, True),
                "most likely": (env, policy, False),
                "script": (env, script_policy(env), True),
                "script+forward": (forward, script_policy(forward), True),
            }
            line: dict[str, object] = {"agents": agents, "outline": outline}
            for kind, (world, flown, sample) in flights.items():
                world.set_seed(SEED)
                horizon = world.uav_env.scenario.episode.max_steps or 0
                line[kind] = evaluate(world, flown, horizon, sample=sample)["return"]
            lines.append(line)
            print(name, line, flush=True)
    return pd.DataFrame(lines)


def returns(name: str, law: tuple[str, ...]) -> dict[str, list[float]]:
    """True mean returns of the policy in each batch, and of others where it flies as it was
    trained."""
    found: dict[str, list[float]] = {}
    for seed in range(SEED, SEED + BATCHES):
        policy, env = damian.load(f"damian:{name}", *law, num_worlds=WORLDS, seed=seed)
        others = {"most likely": policy, "script": script_policy(env), "random": random_policy(env)}
        for kind, flown in {"sampled": policy, **({} if law else others)}.items():
            env.set_seed(seed)
            horizon = env.uav_env.scenario.episode.max_steps or 0
            mean = evaluate(env, flown, horizon, sample=kind != "most likely")["return"]
            found.setdefault(kind, []).append(mean)
    return found


def ship(name: str, run: Path) -> None:
    """Store the policy of a run in the package, fly it, and write its card."""
    folder, (words, limits) = Path(damian.__file__).parent / "data" / name, POLICIES[name]
    folder.mkdir(exist_ok=True)
    actor = read_checkpoint(run / "checkpoint.pt", "checkpoint")["components"]["actor"]
    half = {
        key: each.half() if isinstance(each, torch.Tensor) else each for key, each in actor.items()
    }
    write_checkpoint(folder / "checkpoint.pt", {"components": {"actor": half}})
    settings = nested(stored_config(run, "checkpoint"))
    (folder / "config.yaml").write_text(yaml.safe_dump(settings, sort_keys=False), encoding="utf-8")
    rows = []
    for law, changes in LAWS.items():
        for policy, means in returns(name, changes).items():
            found = torch.tensor(means, dtype=torch.float64)
            half_width = float(stdtrit(BATCHES - 1, 0.975) * found.std()) / math.sqrt(BATCHES)
            mean = float(found.mean())
            rows.append({"law": law, "policy": policy, "return": mean, "interval": half_width})
            print(name, rows[-1], flush=True)
    table = pd.DataFrame(rows).round(3)
    write_csv(folder / "result.csv", table)
    (folder / "README.md").write_text(card(name, run, words, limits, table), encoding="utf-8")


def card(name: str, run: Path, words: str, limits: str, table: pd.DataFrame) -> str:
    """The card of a policy."""
    record = json.loads((run / "run.json").read_text(encoding="utf-8"))
    scenario = (CONF / f"{shlex.split(words)[0].replace('=', '/')}.yaml").read_text(
        encoding="utf-8"
    )
    task = " ".join(line[2:] for line in scenario.splitlines()[2:] if line.startswith("# "))
    cells = {
        (law, policy): f"{mean:.1f} ± {interval:.1f}"
        for law, policy, mean, interval in table.itertuples(index=False, name=None)
    }
    columns = [*table["policy"].unique()]
    lines = [[law, *(cells.get((law, policy), "") for policy in columns)] for law in LAWS]
    return f"""# {name}

`policy, env = damian.load("damian:{name}")`

**Task.** {task} ({shlex.split(words)[0]})

**Limits.** {limits}

**Trained** from late data only, by damian {record["damian"]}, commit {record["commit"][:7]}:

```bash
damian train {words} compile=true
```

**True returns** of {BATCHES * WORLDS} episodes, with 95 % intervals over {BATCHES} batches, by the delay
of the flight; *sampled* and *most likely* are the policy's actions, *script* and *random* fly as late:

{markdown_table(["delay", *columns], lines)}
"""


def main(words: list[str] | None = None) -> None:
    """Train what has not been trained, and store it."""
    parser = ArgumentParser(description="Make the policies of the package.")
    parser.add_argument("names", nargs="*", default=[*POLICIES], help="policies to make")
    parser.add_argument(
        "--runs", type=Path, default=Path("runs/pretrained"), help="folder of the runs"
    )
    args = parser.parse_args(words)
    torch.set_num_threads(1)
    for name in args.names:
        run = args.runs / name
        if not (run / "result.csv").exists():
            command = [
                Path(sys.executable).with_name("damian"),
                "train",
                *shlex.split(POLICIES[name][0]),
            ]
            subprocess.run([*command, "compile=true", f"hydra.run.dir={run}"], check=True)
        ship(name, run)


if __name__ == "__main__":
    main()
