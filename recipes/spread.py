"""Compare with a published table: MAPPO in PettingZoo's simple_spread_v3, with late observations.

    damian spread                             (half an hour on one core; --jobs 2 takes two)
    damian spread --arms undelayed,naive      (these arms only)
    damian spread --seeds 0 --frames 100000 --out runs/spread0

Three agents cover three landmarks in episodes of 25 steps; the return is the sum of all agents' rewards. An
agent knows its own velocity and position at once; it sees each landmark and each other agent late, and begins
with what it sees at the beginning. Arms: random actions; undelayed, trained without delay; and, trained while
each of these messages takes 3 to 9 steps: naive; history, which also observes the ages of what it sees and
its own latest actions; backupdate, whose actor is naive, but whose critic learns from what has arrived since
(``BackupdateStorage``); both of them; and learnt, whose actor also has a learnt belief
(``predictive_mappo``). Each policy is evaluated under several delays, in episodes that begin alike for all.

The run folder (runs/spread, unless --out names another one) gets results.csv, a row for each arm, delay and
seed, and the table of means as table.md beside the published one (Fu et al. 2025, "Rainbow Delay
Compensation", arXiv 2505.03586), and a JSON file for each arm and seed; an arm and seed that has its file is
not trained again.
"""

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from damian import keys
from damian.common import checks
from damian.common.atomic_files import write_atomically
from damian.common.csv_table import csv_table
from damian.common.markdown import markdown_table
from damian.delays.laws import Constant, Law, Uniform
from damian.keys import next_key
from damian.learners.base import LearningSetup
from damian.learners.mappo import Mappo, MappoConfig
from damian.learners.networks import ModelConfig
from damian.learners.predictive_mappo import PredictiveMappoConfig
from damian.replay.backupdate import BackupdateStorage

from .shared.collecting import make_collector
from .shared.command_line import Parser, exits_with_one_line
from .shared.outside_runs import (
    add_options,
    chosen_runs,
    read_result,
    run_all,
    save_result,
)
from .shared.simple_spread import AGES, DELAYS, HELD, HORIZON, KINEMATICS, SEEN, late_spread, observed

LATEST = 9
"""Longest delay in training [steps]; actors observe so many of their actions."""
LATE = Uniform(3, LATEST)
"""The delay of each message in training."""
TRAINED = "3 to 9"
EVALUATED: dict[str, Law] = {**{str(d): Constant(d) for d in (0, 3, 6, 9, 12)}, TRAINED: LATE}
"""The delays under which policies are evaluated [steps], by name."""


class Arm(NamedTuple):
    """What a policy is trained with."""

    delay: Law = LATE
    aware: bool = False
    """Does the actor observe the age of what it sees, and its own latest actions?"""
    backupdate: bool = False
    """Does the critic learn from what has arrived since?"""
    messages: int = 0
    """Number of latest steps whose messages the learnt belief reads; 0 if there is no such belief."""


ARMS: dict[str, Arm | None] = {
    "random": None,
    "undelayed": Arm(Constant(0)),
    "naive": Arm(),
    "history": Arm(aware=True),
    "backupdate": Arm(backupdate=True),
    "both": Arm(aware=True, backupdate=True),
    "learnt": Arm(aware=True, backupdate=True, messages=12),
}
PUBLISHED = {"undelayed": (-33.1, -37.6, -48.8, -59.9, -67.2, ""), "random": (-82.4, *5 * ("",))}
"""Published returns by arm, under the delays that are evaluated."""

WORLDS = 256  # an update learns from one episode of each
MODEL = ModelConfig(hidden=[64, 64], init="orthogonal")
LEARNER: dict[str, Any] = {"steps": HORIZON, "lr": 5e-3, "gamma": 0.9, "lmbda": 0.95, "minibatches": 8}
LEARNER |= {"entropy_coeff": 0.003, "entropy_coeff_end": 0.0, "normalize_value": True}
BELIEF: dict[str, Any] = {"prediction_steps": 20, "prediction_batch": 256, "heads": 2, "width": 16}
EVALUATION_SEED = 1000  # of the initial conditions in every evaluation


class Run(NamedTuple):
    """One arm with one seed."""

    arm: str
    seed: int
    frames: int
    episodes: int


ACTING = {"mode": ExplorationType.DETERMINISTIC, "sampled": ExplorationType.RANDOM}
"""How an evaluated policy acts: by its most likely action, or by one that is drawn from it."""
Returns = dict[str, dict[str, float]]
"""Mean returns by delay, and by how the policy acts."""


def make_env(arm: Arm, worlds: int, delay: Law) -> TransformedEnv:
    """The environment of an arm, under a delay."""
    return late_spread(worlds, delay, LATEST, aware=arm.aware, messages=arm.messages)


def recompute(steps: TensorDictBase, blocks: Tensor) -> dict[NestedKey, Tensor]:
    """What critics would have observed after steps [T, B], had these blocks [T, B, K, 2] arrived at once."""
    kinematics = steps[next_key(KINEMATICS)]
    changed = (blocks != steps[next_key(HELD)]).any(-1).unflatten(-1, (kinematics.shape[-2], -1))
    return {
        next_key(keys.GLOBAL_OBSERVATION): observed(kinematics, blocks),
        next_key(keys.BACKUPDATED): changed.any(-1, keepdim=True),
    }


def make_learner(env: EnvBase, arm: Arm, frames: int) -> Mappo:
    """The learner that also trains UAVs: MAPPO, with back-updating and a learnt belief if the arm says so."""
    config = PredictiveMappoConfig(**LEARNER, **BELIEF) if arm.messages else MappoConfig(**LEARNER)
    setup = LearningSetup(
        MODEL,
        WORLDS,
        HORIZON,
        HORIZON,
        LATEST,
        backupdate=arm.backupdate,
        settle=arm.backupdate,
        frames=frames,
    )
    config.check(setup)
    size = config.buffer_size(setup)
    if size is None:
        return config.make(env, setup, None)
    names = {"message_key": SEEN, "received_key": HELD, "delay_key": DELAYS, "age_key": AGES}
    storage = BackupdateStorage(size, recompute, LATEST, env=env, **names)
    return config.make(env, setup, ReplayBuffer(storage=storage))


def train(arm: Arm, run: Run, bar: tqdm) -> nn.Module:
    """Train for at least ``frames`` environment steps; returns the policy."""
    env = make_env(arm, WORLDS, arm.delay)
    env.set_seed(run.seed)
    learner, done = make_learner(env, arm, run.frames), 0
    collector = make_collector(env, learner.actor, WORLDS * HORIZON)
    for batch in collector:
        learner.learn(batch)
        bar.set_postfix({"return": f"{returns_in(batch):.1f}"})
        bar.update(min(batch.numel(), run.frames - done))
        done += batch.numel()
        if done >= run.frames:
            break
    collector.shutdown()
    return learner.actor


def returns_in(batch: TensorDictBase) -> float:
    """Mean return of the episodes in a batch [B, HORIZON]."""
    return cast(Tensor, batch[next_key(keys.REWARD)]).flatten(1).sum(1).mean().item()


@torch.no_grad()
def evaluate(arm: Arm, actor: nn.Module | None, delay: Law, episodes: int) -> dict[str, float]:
    """Mean returns over episodes that have the same initial conditions at every call."""
    returns = {}
    for name, how in ACTING.items():
        env = make_env(arm, episodes, delay)
        env.set_seed(EVALUATION_SEED)
        with set_exploration_type(how):
            returns[name] = returns_in(env.rollout(HORIZON, actor, break_when_any_done=False))
    return returns


def run_arm(run: Run, folder: Path, place: int) -> None:
    """Train, evaluate and write the result; ``place`` is the line of the progress bar."""
    torch.set_num_threads(1)
    torch.manual_seed(run.seed)
    trained, actor = ARMS[run.arm], None
    arm = trained or Arm()
    if trained:
        with tqdm(total=run.frames, desc=f"seed {run.seed} {run.arm}", position=place) as bar:
            actor = train(arm, run, bar)
    returns = {name: evaluate(arm, actor, law, run.episodes) for name, law in EVALUATED.items()}
    save_result(run, folder, returns)


def is_good(returns: Any) -> bool:
    """Whether something can be ``Returns``."""
    each = [returns.get(delay) for delay in EVALUATED] if isinstance(returns, dict) else [None]
    return all(
        isinstance(found, dict) and all(isinstance(found.get(name), float) for name in ACTING)
        for found in each
    )


def table(runs: Sequence[Run], folder: Path) -> str:
    """Write the results as results.csv and table.md; returns the latter's text."""
    results: dict[Run, Returns] = {run: read_result(run, folder, is_good)["returns"] for run in runs}
    rows = [
        [run.arm, delay, run.seed, *(f"{returns[delay][name]:.2f}" for name in ACTING)]
        for run, returns in results.items()
        for delay in EVALUATED
    ]
    write_atomically(folder / "results.csv", csv_table([["arm", "delay", "seed", *ACTING], *rows]))
    n_seeds = len({run.seed for run in runs})
    parts = [
        f"# simple_spread_v3, MAPPO, {runs[0].frames} steps: returns",
        f"Mean of {runs[0].episodes} episodes and {n_seeds} seeds (smallest and largest mean of a seed), by "
        "delay [steps]. Recovery: (arm - naive) / (undelayed without delay - naive).",
    ]
    for name in ACTING:
        values = {(run.arm, delay): [] for run in runs for delay in EVALUATED}
        for run, returns in results.items():
            for delay in EVALUATED:
                values[run.arm, delay].append(returns[delay][name])
        arms = dict.fromkeys(run.arm for run in runs)
        lines = [[arm, *cells(values, arm), recovery(values, arm)] for arm in arms]
        lines += [[f"{arm}, published", *map(str, known), ""] for arm, known in PUBLISHED.items()]
        parts += [f"## Actions: {name}", markdown_table(["arm", *EVALUATED, "recovery"], lines)]
    text = "\n\n".join(parts) + "\n"
    write_atomically(folder / "table.md", text)
    return text


def cells(values: dict[tuple[str, str], list[float]], arm: str) -> list[str]:
    """An arm's mean return over the seeds, and the range of their means, for each delay."""
    found = [values[arm, delay] for delay in EVALUATED]
    return [f"{statistics.mean(each):.1f} ({min(each):.1f}, {max(each):.1f})" for each in found]


def recovery(values: dict[tuple[str, str], list[float]], arm: str) -> str:
    """(arm - naive) / (undelayed - naive) of an arm that is trained under the delay; empty for others."""
    known = {("undelayed", "0"), ("naive", TRAINED)} <= {*values}
    if arm in ("random", "undelayed") or not known:
        return ""
    own, naive, undelayed = (
        statistics.mean(values[key]) for key in ((arm, TRAINED), ("naive", TRAINED), ("undelayed", "0"))
    )
    return f"{(own - naive) / (undelayed - naive):.0%}" if undelayed != naive else ""


def parse(words: Sequence[str] | None) -> tuple[list[Run], Path, int]:
    """The runs that the command line asks for, their folder, and the number of processes.

    Raises:
        InputError: an option is unknown, or its value is impossible.
    """
    parser = Parser(description="MAPPO in simple_spread_v3 with late observations, beside a published table.")
    add_options(parser, list(ARMS), "runs/spread")
    parser.add_argument(
        "--frames", type=int, default=1_000_000, help="training steps of each arm, over all worlds"
    )
    parser.add_argument("--episodes", type=int, default=1000, help="episodes of each evaluation")
    args = parser.parse_args(words)
    for name, most in (("frames", 10_000_000_000), ("episodes", 100_000)):
        checks.in_range(f"--{name}", getattr(args, name), 1, most)
    runs = [Run(arm, seed, args.frames, args.episodes) for arm, seed in chosen_runs(args, list(ARMS))]
    return runs, args.out, args.jobs


def main(words: Sequence[str] | None = None) -> None:
    """Train, evaluate and print the table; wrong input ends with one line on stderr and exit code 2."""
    with exits_with_one_line():
        runs, folder, jobs = parse(words)
        run_all(runs, folder, jobs, run_arm, is_good)
        print(f"{table(runs, folder)}\nresults: {folder}")


def run() -> None:
    """Run the program with the words of the command line."""
    main()


if __name__ == "__main__":
    run()
