"""The delay transforms outside our own environment: SAC on Gymnasium's Pendulum-v1 with late observations.

    python recipes/pendulum.py --jobs 2                  (a quarter of an hour on two free cores)
    python recipes/pendulum.py --seeds 0 --steps 10000 --delay 3 --out runs/pendulum3

Three arms learn for each seed: undelayed; naive, which sees late observations and nothing else; and history,
which sees its own latest actions beside them. The undelayed policy is also deployed under delays. What is
finished stays in the run folder and is not done again; the table goes there as results.md and results.csv.
"""

import argparse
import csv
import json
import multiprocessing
import os
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, NoReturn

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import torch
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import (
    Compose,
    EnvBase,
    GymEnv,
    RenameTransform,
    RewardSum,
    SerialEnv,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from damian import keys
from damian.common import checks
from damian.common.errors import InputError
from damian.common.markdown import markdown_table
from damian.keys import next_key
from damian.learners.base import LearningSetup
from damian.learners.networks import ModelConfig
from damian.learners.sac import Sac, SacConfig
from damian.transforms import ActionHistory, ObservationDelay

ARMS = ("undelayed", "naive", "history")
DEPLOYED = {0: -145, 2: -153, 3: -324, 4: -757, 6: -777, 8: -977}
REFERENCE = {("undelayed", d): r for d, r in DEPLOYED.items()} | {("naive", 6): -1154, ("history", 6): -155}
"""Returns by arm and delay: one seed of an independent implementation, 20 000 steps; for orientation."""

HORIZON = 200  # steps of an episode
RANDOM_STEPS = 1000  # before learning begins
EVALUATION_SEED = 1000  # of the first positions in every evaluation
BATCH, LR, GAMMA, TAU = 256, 1e-3, 0.99, 0.005
STORED = [
    keys.OBSERVATION,
    keys.ACTION,
    *map(next_key, (keys.OBSERVATION, keys.REWARD, keys.DONE, keys.TERMINATED)),
]


class Run(NamedTuple):
    """One arm with one seed."""

    arm: str
    seed: int
    steps: int
    delay: int
    episodes: int
    hidden: int

    def file(self, folder: Path) -> Path:
        """Where the result is kept."""
        return folder / f"seed{self.seed}_{self.arm}.json"


def make_env(delay: int, history: int, worlds: int | None = None) -> EnvBase:
    """Pendulum, once or in a batch, with late observations and a memory of the last actions."""

    def one() -> EnvBase:
        return GymEnv("Pendulum-v1")

    transforms: list[Transform] = [RewardSum(), ObservationDelay(delay, age_key=None)]
    if history:
        transforms.append(ActionHistory(history, append_to="observation"))
    # The names that our learner knows; the only agent needs no dimension of its own.
    outputs = {"observation": keys.OBSERVATION, "reward": keys.REWARD}
    transforms.append(RenameTransform([*outputs], [*outputs.values()], ["action"], [keys.ACTION]))
    return TransformedEnv(SerialEnv(worlds, one) if worlds else one(), Compose(transforms))


def make_learner(env: EnvBase, run: Run) -> Sac:
    """The learner of our UAVs, on a memory that takes single steps."""
    config = SacConfig(lr=LR, alpha_lr=LR, gamma=GAMMA, tau=TAU, alpha_init=1.0)
    buffer = ReplayBuffer(storage=LazyTensorStorage(run.steps), batch_size=BATCH)
    model = ModelConfig(hidden=[run.hidden, run.hidden], activation="relu")
    setup = LearningSetup(model, 1, 1, 1, critic_key=keys.OBSERVATION)
    return Sac(env, config, setup, buffer)


def train(env: EnvBase, learner: Sac, steps: int, bar: tqdm) -> None:
    """Learn for so many steps, with one update after each."""
    seen = env.reset()
    for step in range(steps):
        with torch.no_grad():
            chosen = env.rand_action(seen) if step < RANDOM_STEPS else learner.actor(seen)
            after, seen = env.step_and_maybe_reset(chosen)
        learner.buffer.add(after.select(*STORED))
        if step >= RANDOM_STEPS:
            learner.update(learner.buffer.sample())
        bar.update()
        if after["next", "done"].item():
            bar.set_postfix({"return": f"{after['next', 'episode_reward'].item():.0f}"})


@torch.no_grad()
def evaluate_under(delay: int, history: int, actor: nn.Module, episodes: int) -> float:
    """Mean return of the policy's mode; the episodes begin alike, whoever flies them."""
    env = make_env(delay, history, episodes)
    env.set_seed(EVALUATION_SEED)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        flown = env.rollout(HORIZON, actor, break_when_any_done=False)
    env.close()
    return flown[next_key(keys.REWARD)].sum(1).mean().item()


def run_arm(run: Run, folder: Path, place: int) -> None:
    """Train, evaluate and keep the result; ``place`` is the line of the progress bar."""
    torch.set_num_threads(1)
    torch.manual_seed(run.seed)
    delay = 0 if run.arm == "undelayed" else run.delay
    history = run.delay if run.arm == "history" else 0
    env = make_env(delay, history)
    env.set_seed(run.seed)
    learner = make_learner(env, run)
    with tqdm(total=run.steps, desc=f"seed {run.seed} {run.arm}", position=place) as bar:
        train(env, learner, run.steps, bar)
    delays = sorted({*DEPLOYED, run.delay}) if run.arm == "undelayed" else [delay]
    returns = {d: evaluate_under(d, history, learner.actor, run.episodes) for d in delays}
    partly = run.file(folder).with_suffix(".part")  # all of it or nothing
    partly.write_text(json.dumps({**run._asdict(), "returns": returns}))
    partly.replace(run.file(folder))


def run_all(runs: Sequence[Run], folder: Path, jobs: int) -> None:
    """Do what is not done yet, in so many processes."""
    todo = [run for run in runs if returns_of(run, folder) is None]
    work = [(run, folder, place) for place, run in enumerate(todo)]
    if jobs == 1:
        for one in work:
            run_arm(*one)
        return
    spawn = multiprocessing.get_context("spawn")
    tqdm.set_lock(spawn.RLock())
    with spawn.Pool(jobs, initializer=tqdm.set_lock, initargs=(tqdm.get_lock(),)) as pool:
        pool.starmap(run_arm, work, chunksize=1)


def returns_of(run: Run, folder: Path) -> dict[str, float] | None:
    """Mean return by the delay of the evaluation; None if the run is not done."""
    file = run.file(folder)
    if not file.exists():
        return None
    saved = json.loads(file.read_text())
    for name, value in run._asdict().items():
        should = f"is not the {saved[name]} of {file}; choose another --out"
        checks.require(saved[name] == value, f"--{name}", value, should)
    return saved["returns"]


def table(runs: Sequence[Run], folder: Path) -> str:
    """Write the results as CSV and as Markdown, which is returned."""
    rows = [
        ["arm", "delay", "mean", *(f"seed {run.seed}" for run in runs if run.arm == ARMS[0]), "reference"]
    ]
    for arm in ARMS:
        results = [returns_of(run, folder) or {} for run in runs if run.arm == arm]
        for delay in results[0]:
            values = [result[delay] for result in results]
            numbers = [f"{value:.0f}" for value in (statistics.mean(values), *values)]
            rows.append([arm, delay, *numbers, str(REFERENCE.get((arm, int(delay)), ""))])
    with (folder / "results.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    title = f"# Pendulum-v1, SAC, {runs[0].steps} steps: return, mean of {runs[0].episodes} episodes"
    told = f"{title}\n\n{markdown_table(rows[0], rows[1:])}\n"
    (folder / "results.md").write_text(told)
    return told


class Parser(argparse.ArgumentParser):
    """Refuses in one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(message)


def parse(words: Sequence[str] | None) -> tuple[list[Run], Path, int]:
    """The runs that the command line asks for, their folder, and in how many processes."""
    parser = Parser(description="SAC on Pendulum-v1 with late observations.")
    parser.add_argument("--seeds", default="0,1,2", help="such as 0,1,2")
    parser.add_argument("--steps", type=int, default=20_000, help="of training, each arm")
    parser.add_argument("--delay", type=int, default=6, help="of the observations [steps]")
    parser.add_argument("--episodes", type=int, default=20, help="of each evaluation")
    parser.add_argument("--hidden", type=int, default=128, help="units in each of two hidden layers")
    parser.add_argument("--out", type=Path, default=Path("runs/pendulum"), help="run folder")
    parser.add_argument("--jobs", type=int, default=1, help="processes, a thread each")
    asked = parser.parse_args(words)
    seeds = asked.seeds.split(",")
    known = all(seed.isdecimal() for seed in seeds) and len({*map(int, seeds)}) == len(seeds)
    checks.require(known, "--seeds", asked.seeds, "is not a list of different whole numbers such as 0,1,2")
    checks.above("--steps", asked.steps, RANDOM_STEPS)
    checks.in_range("--delay", asked.delay, 1, HORIZON, "steps")
    for name in ("episodes", "hidden", "jobs"):
        checks.in_range(f"--{name}", getattr(asked, name), 1)
    settings = asked.steps, asked.delay, asked.episodes, asked.hidden
    return [Run(arm, int(seed), *settings) for seed in seeds for arm in ARMS], asked.out, asked.jobs


def main(words: Sequence[str] | None = None) -> None:
    """Train, evaluate and tell; what a person got wrong is one line and exit code 2."""
    try:
        runs, folder, jobs = parse(words)
        folder.mkdir(parents=True, exist_ok=True)
        run_all(runs, folder, jobs)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    print(f"{table(runs, folder)}\nwritten to {folder}")


if __name__ == "__main__":
    main()
