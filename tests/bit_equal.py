"""Prints digests of rollouts and of trainings: a refactoring must not change a bit.

    python tests/bit_equal.py > before.txt    # with the older version installed
    python tests/bit_equal.py > after.txt     # with the newer one
    diff before.txt after.txt

A line is an entry of one of 54 rollouts with random actions, or what one of 12 trainings wrote in
an update or of a policy. It is good on one machine only: another processor rounds in another way.
"""

import csv
import hashlib
import subprocess
import sys
import tempfile
from itertools import product
from pathlib import Path

import torch

import damian

SCENARIOS = (
    "spotting tracking coverage energy mixed delaybench/tracking delaybench/intermittent "
    "delaybench/flights delaybench/coverage paper/usecase1 paper/usecase2"
)
DELAYS = ["delay=none", "delay=paper", "delay.obs=4", "delay=burst aware=belief"]
OTHERS = """
tracking delay=lag motion=polynomial
energy delay=distance actions=continuous motion=polynomial
mixed delay=paper delay.act=2 delay.rew=3 delay.history=4 aware=backupdate+history
coverage region=random agents=5 delay.obs=2 observation.own=true
tracking links=matrix delay=paper
tracking links=updown delay=paper
spotting clock.agents=4 clock.server=2 delay=paper
delaybench/crowded aware=timeline delay.obs=1..7
delaybench/flights aware=timeline delay=lag delay.act=2
tracking aware=timeline links=matrix delay=paper
"""
TRAININGS = """
spotting aware=belief delay=paper
delaybench/tracking delay.obs=4 aware=backupdate observation.own=true
delaybench/tracking delay=paper aware=backupdate+history settle=true
delaybench/flights delay=paper aware=belief
delaybench/coverage region=random
tracking model=gru delay=paper
tracking learner=sac delay=paper aware=backupdate
tracking learner=sac actions=continuous
tracking learner=bpql delay.obs=2 aware=backupdate+history
paper/usecase2 delay=paper aware=backupdate+history corrected=[reward,critic,actor]
delaybench/crowded delay=burst aware=timeline
delaybench/flights delay.obs=1..7 aware=timeline model=gru
"""
SHORT = "frames=12000 worlds=32 eval_episodes=20 seed=5 logger=csv"
TIMES = ("seconds", "steps_per_second")
"""Columns that another run has otherwise."""


def digest(tensor):
    """Hash of a tensor's type, shape and bits."""
    head = f"{tensor.dtype}{tuple(tensor.shape)}".encode()
    content = tensor.detach().contiguous().flatten().view(torch.uint8)
    return hashlib.sha256(head + content.numpy().tobytes()).hexdigest()[:16]


def print_rollout(case):
    """A digest of every entry of a rollout of 40 steps in 8 worlds."""
    torch.manual_seed(0)
    scenario = damian.compose_scenario(*f"scenario={case}".split())
    env = damian.make_env(scenario, num_worlds=8, seed=3)
    steps = env.rollout(40, break_when_any_done=False)
    for key, value in sorted(steps.items(True, True), key=str):
        print("rollout", case, key, digest(value), flush=True)


def print_training(case):
    """The numbers of a short training and of its evaluation."""
    with tempfile.TemporaryDirectory() as folder:
        program = str(Path(sys.executable).with_name("damian"))
        words = f"train {SHORT} scenario={case} hydra.run.dir={folder}/run".split()
        subprocess.run([program, *words], check=True, stdout=subprocess.DEVNULL)
        for name in ("metrics.csv", "result.csv"):
            for row in csv.DictReader(Path(folder, "run", name).read_text("utf-8").splitlines()):
                same = {column: row[column] for column in row if not column.endswith(TIMES)}
                print("training", case, name, same, flush=True)


if __name__ == "__main__":
    for scenario, delay in product(SCENARIOS.split(), DELAYS):
        print_rollout(f"{scenario} {delay}")
    for case in OTHERS.strip().splitlines():
        print_rollout(case)
    for case in TRAININGS.strip().splitlines():
        print_training(case)
