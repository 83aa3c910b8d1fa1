"""Records rollouts and trainings, and compares two records: a refactoring must not change a bit.

    python tests/bit_equal.py record before.json           # with the older version installed
    python tests/bit_equal.py record after.json            # with the newer one
    python tests/bit_equal.py record after.json flights    # only cases whose name has this word
    python tests/bit_equal.py compare before.json after.json

A record holds a digest of every entry of 54 rollouts with random actions, and the numbers that 12
trainings
wrote. It is good on one machine only: another processor rounds in another way.
"""

import csv
import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

SCENARIOS = [
    ["scenario=spotting"],
    ["scenario=tracking"],
    ["scenario=coverage"],
    ["scenario=energy"],
    ["scenario=mixed"],
    ["scenario=delaybench/tracking"],
    ["scenario=delaybench/intermittent"],
    ["scenario=delaybench/flights"],
    ["scenario=delaybench/coverage"],
    ["scenario=paper/usecase1"],
    ["scenario=paper/usecase2"],
]
DELAYS = [["delay=none"], ["delay=paper"], ["delay.obs=4"], ["delay=burst", "aware=belief"]]
LATE = ["delay.act=2", "delay.rew=3", "delay.history=4"]
OTHERS = [
    ["scenario=tracking", "delay=lag", "motion=polynomial"],
    ["scenario=energy", "delay=distance", "actions=continuous", "motion=polynomial"],
    ["scenario=mixed", "delay=paper", *LATE, "aware=backupdate+history"],
    ["scenario=coverage", "region=random", "agents=5", "delay.obs=2", "observation.own=true"],
    ["scenario=tracking", "links=matrix", "delay=paper"],
    ["scenario=tracking", "links=updown", "delay=paper"],
    ["scenario=spotting", "clock.agents=4", "clock.server=2", "delay=paper"],
    ["scenario=delaybench/crowded", "aware=timeline", "delay.obs={law: uniform, low: 1, high: 7}"],
    ["scenario=delaybench/flights", "aware=timeline", "delay=lag", "delay.act=2"],
    ["scenario=tracking", "aware=timeline", "links=matrix", "delay=paper"],
]
TRAININGS = [
    ["scenario=spotting", "aware=belief", "delay=paper"],
    ["scenario=delaybench/tracking", "delay.obs=4", "aware=backupdate", "observation.own=true"],
    ["scenario=delaybench/tracking", "delay=paper", "aware=backupdate+history", "settle=true"],
    ["scenario=delaybench/flights", "delay=paper", "aware=belief"],
    ["scenario=delaybench/coverage", "region=random"],
    ["scenario=tracking", "model=gru", "delay=paper"],
    ["scenario=tracking", "learner=sac", "delay=paper", "aware=backupdate"],
    ["scenario=tracking", "learner=sac", "actions=continuous"],
    ["scenario=tracking", "learner=bpql", "delay.obs=2", "aware=backupdate+history"],
    [
        "scenario=paper/usecase2",
        "delay=paper",
        "aware=backupdate+history",
        "corrected=[reward,critic,actor]",
    ],
    ["scenario=delaybench/crowded", "delay=burst", "aware=timeline"],
    [
        "scenario=delaybench/flights",
        "delay.obs={law: uniform, low: 1, high: 7}",
        "aware=timeline",
        "model=gru",
    ],
]
TRAINED = ("loss", "kl", "entropy", "return", "success", "steps", "age")
"""Beginnings and endings of the columns of metrics.csv and result.csv that count."""


def digest(tensor: torch.Tensor) -> str:
    """Hash of a tensor's type, shape and bits."""
    content = tensor.detach().cpu().contiguous()
    head = f"{content.dtype}{tuple(content.shape)}".encode()
    return hashlib.sha256(head + content.flatten().view(torch.uint8).numpy().tobytes()).hexdigest()[
        :16
    ]


def rollout(overrides: list[str]) -> dict[str, str]:
    """A digest of every entry of a rollout of 40 steps in 8 worlds, by its key."""
    import damian  # noqa: PLC0415 (the version that is installed)

    torch.manual_seed(0)
    env = damian.make_env(damian.compose_scenario(*overrides), num_worlds=8, seed=3)
    steps = env.rollout(40, break_when_any_done=False)
    leaves = steps.items(include_nested=True, leaves_only=True)
    return {
        "/".join((key,) if isinstance(key, str) else key): digest(value) for key, value in leaves
    }


def training(overrides: list[str]) -> dict[str, list[str]]:
    """The numbers of a short training and of its evaluation."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["frames=12000", "worlds=32", "eval_episodes=20", "seed=5", "logger=csv"]
        command = [str(Path(sys.executable).parent / "damian"), "train", *words, *overrides]
        subprocess.run([*command, f"hydra.run.dir={folder}/run"], check=True, capture_output=True)
        found = {}
        for name in ("metrics.csv", "result.csv"):
            with (Path(folder) / "run" / name).open(newline="") as file:
                rows = list(csv.DictReader(file))
            for column in rows[0]:
                if any(word in column for word in TRAINED):
                    found[f"{name}:{column}"] = [row[column] for row in rows]
        return found


def record(path: Path, word: str = "") -> None:
    """Write the record of the version that is installed, of all cases whose name has a word."""
    cases = [[*scenario, *delay] for scenario in SCENARIOS for delay in DELAYS] + OTHERS
    content = (
        json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    )  # of a stopped call
    for kind, overrides in [
        *(("rollout", case) for case in cases),
        *(("training", c) for c in TRAININGS),
    ]:
        name = f"{kind} {' '.join(overrides)}"
        if word not in name or name in content:
            continue
        print(name, flush=True)
        try:
            content[name] = rollout(overrides) if kind == "rollout" else training(overrides)
        except subprocess.CalledProcessError as error:
            raise SystemExit(f"{name}: {error.stderr.decode()}") from error
        path.write_text(json.dumps(content, indent=1), encoding="utf-8")


def compare(before: Path, after: Path) -> int:
    """Print what differs between two records; returns the number of differences."""
    old = json.loads(before.read_text(encoding="utf-8"))
    new = json.loads(after.read_text(encoding="utf-8"))
    differences = 0
    for name, entries in ((name, old[name]) for name in old if name in new):
        for key in [key for key in entries if key in new.get(name, {})]:
            if entries[key] != new[name][key]:
                differences += 1
                print(f"differs: {name}: {key}")
        if gone := sorted(set(entries) - set(new.get(name, {}))):
            print(f"only before: {name}: {' '.join(gone)}")
    print(f"{len(new)} of {len(old)} cases, {differences} entries differ")
    return differences


if __name__ == "__main__":
    if sys.argv[1] == "record":
        record(Path(sys.argv[2]), *sys.argv[3:])
    else:
        sys.exit(bool(compare(Path(sys.argv[2]), Path(sys.argv[3]))))
