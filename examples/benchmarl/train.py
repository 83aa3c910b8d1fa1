"""Trains an algorithm of BenchMARL where observations arrive late, and compares it with random
actions.

    python examples/benchmarl/train.py --algorithm qmix --scenario delaybench/tracking --delay 4
    python examples/benchmarl/train.py --algorithm masac --scenario vmas/navigation --delay 4

Exit code 1 says that the trained policy is not clearly better than random actions
(by three standard errors), 2 that a setting is wrong.
"""

import argparse
import sys
import time
from pathlib import Path

import compat  # noqa: F401  before BenchMARL
import torch
import yaml
from benchmarl.algorithms import MappoConfig, MasacConfig, QmixConfig
from benchmarl.algorithms.common import AlgorithmConfig
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from torch import Tensor
from uav_task import UavTask
from vmas_delay import DelayedVmasTask

from damian import set_seed
from damian.baselines.random import random_policy
from damian.common.errors import InputError
from damian.common.tables import markdown_table

ALGORITHMS = {"mappo": MappoConfig, "masac": MasacConfig, "qmix": QmixConfig}
AWARE = ("aware=history", "observation.own=true")
"""A UAV knows its own latest message at once, and its latest actions."""
WORLDS, STEPS = 32, 50
"""Worlds that are stepped as one batch, and their steps between two updates: an episode of
delaybench."""
EVALUATIONS, EPISODES = 10, 20
"""A policy is evaluated with these many seeds, in these many episodes each."""


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--algorithm", choices=ALGORITHMS, default="mappo")
    parser.add_argument(
        "--scenario", default="delaybench/tracking", help="of damian train, or vmas/NAME"
    )
    parser.add_argument("--delay", default="4", help="steps, or a law, as in damian train")
    parser.add_argument("--frames", type=int, default=64_000, help="steps in all worlds together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--continuous", action="store_true", help="continuous actions; QMIX has none"
    )
    parser.add_argument(
        "--folder", type=Path, default=Path("runs/benchmarl"), help="for BenchMARL's logs"
    )
    parser.add_argument(
        "overrides", nargs="*", help="further settings of the UAVs, such as agents=5"
    )
    return parser.parse_args()


def make_task(args: argparse.Namespace) -> UavTask | DelayedVmasTask:
    """The task of ``--scenario``, with its delay."""
    if args.scenario.startswith("vmas/"):
        return DelayedVmasTask(
            args.scenario.removeprefix("vmas/"), delay=yaml.safe_load(args.delay)
        )
    settings = [f"scenario={args.scenario}", f"delay.obs={args.delay}", *AWARE, *args.overrides]
    return UavTask(args.scenario.replace("/", "_"), {"overrides": settings})


def algorithm_config(name: str) -> AlgorithmConfig:
    """BenchMARL's own settings, but for what a short run needs."""
    config = ALGORITHMS[name].get_from_yaml()
    if name == "mappo":
        config.entropy_coef = 0.01
    if name == "masac":
        config.alpha_init = 0.01  # a larger entropy bonus would outweigh the small rewards
    return config


def experiment_config(args: argparse.Namespace) -> ExperimentConfig:
    """BenchMARL's own settings, but for the size of a short run on one core."""
    config = ExperimentConfig.get_from_yaml()
    config.max_n_frames = args.frames
    config.save_folder = str(args.folder)
    config.prefer_continuous_actions = args.continuous
    config.lr, config.gamma = 1e-3, 0.9  # those of delaybench with DAMIAN's own learners
    config.on_policy_n_envs_per_worker = config.off_policy_n_envs_per_worker = WORLDS
    batch = WORLDS * STEPS
    config.on_policy_collected_frames_per_batch = config.off_policy_collected_frames_per_batch = (
        batch
    )
    config.on_policy_n_minibatch_iters = 10
    config.on_policy_minibatch_size = 400
    config.off_policy_n_optimizer_steps = 100
    config.off_policy_train_batch_size = 256
    config.off_policy_memory_size = 200_000
    config.evaluation = config.render = config.create_json = False
    config.loggers = ["csv"]
    return config


def returns(task: UavTask | DelayedVmasTask, experiment: Experiment) -> dict[str, Tensor]:
    """Mean returns [EVALUATIONS] of each policy, all in the same episodes."""
    env = task.evaluation_env(EPISODES, experiment.continuous_actions, seed=1000)
    policies = {
        "trained, sampled": (experiment.policy, True),
        "trained, mode": (experiment.policy, False),
        "random": (random_policy(env), True),
    }
    found: dict[str, list[float]] = {name: [] for name in policies}
    for seed in range(EVALUATIONS):
        for name, (policy, sample) in policies.items():
            set_seed(env, 2000 + seed)
            torch.manual_seed(seed)
            found[name].append(task.mean_return(env, policy, sample))
    return {name: torch.tensor(values) for name, values in found.items()}


def standard_error(values: Tensor) -> float:
    """Standard error of the mean of values [EVALUATIONS]."""
    return float(values.std() / len(values) ** 0.5)


def main() -> None:
    """Train, print a table, and say by the exit code whether anything was learnt."""
    args = arguments()
    torch.set_num_threads(1)
    args.folder.mkdir(parents=True, exist_ok=True)
    model = MlpConfig.get_from_yaml()
    config = experiment_config(args)
    model.num_cells = [64, 64]
    try:
        task = make_task(args)
        experiment = Experiment(task, algorithm_config(args.algorithm), model, args.seed, config)
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    began = time.monotonic()
    experiment.run()
    duration = time.monotonic() - began
    measured = returns(task, experiment)
    print(
        f"\n{args.algorithm}, {args.scenario}, delay {args.delay}, seed {args.seed}: "
        f"{experiment.total_frames} frames in {duration:.0f} s\n"
    )
    rows = [
        [name, f"{each.mean():.2f}", f"{standard_error(each):.2f}"]
        for name, each in measured.items()
    ]
    print(markdown_table(["policy", "return", "standard error"], rows))
    gain = measured["trained, sampled"] - measured["random"]
    if gain.mean() <= 3 * standard_error(gain):
        sys.exit("the trained policy is not clearly better than random actions")


if __name__ == "__main__":
    main()
