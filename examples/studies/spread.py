"""Compare with a published table: MAPPO in PettingZoo's simple_spread_v3, with late observations.

    python examples/studies/spread.py                          (half an hour on one core; --jobs 2 takes two)
    python examples/studies/spread.py --arms undelayed naive   (these arms only)
    python examples/studies/spread.py --seeds 0 --frames 100000 --out runs/spread0

Three agents cover three landmarks in episodes of 25 steps; the return is the sum of all agents' rewards. An
agent knows its own velocity and position at once; it sees each landmark and each other agent late, and begins
with what it sees at the beginning. Arms: random actions; undelayed, trained without delay; and, trained while
each of these messages takes 3 to 9 steps: naive; history, which also observes the ages of what it sees and
its own latest actions; backupdate, whose actor is naive, but whose critic learns from what has arrived since
(``BackupdateStorage``); both of them; and learnt, whose actor also has a learnt belief
(``predictive_mappo``). Each policy is evaluated under several delays, in episodes that begin alike for all.

The folder gets results.csv, a row for each arm, delay and seed, the means as table.md beside those published
(Fu et al. 2025, "Rainbow Delay Compensation", arXiv 2505.03586), and a JSON file for each arm and seed.
"""

import csv
import statistics
from argparse import Namespace
from typing import Any, NamedTuple, cast

import torch
from simple_spread import AGES, DELAYS, HELD, HORIZON, KINEMATICS, SEEN, late_spread, observed
from study import Results, carried_out, parser
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from damian import keys, set_seed
from damian.common.tables import markdown_table
from damian.delays.laws import Constant, Law, Uniform
from damian.keys import next_key
from damian.learners.base import LearningSetup
from damian.learners.mappo import Mappo, MappoConfig
from damian.learners.networks import ModelConfig
from damian.learners.predictive_mappo import PredictiveMappoConfig
from damian.replay.backupdate import BackupdateStorage

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
ACTING = {"deterministic": ExplorationType.DETERMINISTIC, "sampled": ExplorationType.RANDOM}
"""How an evaluated policy acts: by its most likely action, or by one that is drawn from it."""


def make_env(arm: Arm, worlds: int, delay: Law) -> TransformedEnv:
    """The environment of an arm, under a delay."""
    return late_spread(worlds, delay, LATEST, aware=arm.aware, messages=arm.messages)


def recompute(steps: TensorDictBase, blocks: Tensor) -> dict[NestedKey, Tensor]:
    """What critics would have observed after steps [T, B], had these blocks [T, B, K, 2] arrived at once."""
    return {next_key(keys.GLOBAL_OBSERVATION): observed(steps[next_key(KINEMATICS)], blocks)}


def make_learner(env: EnvBase, arm: Arm, frames: int) -> Mappo:
    """The learner that also trains UAVs: MAPPO, with back-updating and a learnt belief if the arm says so."""
    config = PredictiveMappoConfig(**LEARNER, **BELIEF) if arm.messages else MappoConfig(**LEARNER)
    late = {"backupdate": arm.backupdate, "settle": arm.backupdate}
    setup = LearningSetup(MODEL, WORLDS, HORIZON, HORIZON, LATEST, frames=frames, **late)
    size = config.buffer_size(setup)
    if size is None:
        return config.make(env, setup, None)
    names = {"message_key": SEEN, "received_key": HELD, "delay_key": DELAYS, "age_key": AGES}
    storage = BackupdateStorage(size, recompute, LATEST, **names)
    return config.make(env, setup, ReplayBuffer(storage=storage))


def train(arm: Arm, seed: int, frames: int, bar: tqdm) -> nn.Module:
    """Train for at least ``frames`` environment steps; returns the policy."""
    env = make_env(arm, WORLDS, arm.delay)
    set_seed(env, seed)
    learner, done = make_learner(env, arm, frames), 0
    collector = Collector(
        env,
        learner.actor,
        frames_per_batch=WORLDS * HORIZON,
        total_frames=-1,
        auto_register_policy_transforms=True,
    )
    for batch in collector:
        learner.learn(batch)
        bar.set_postfix({"return": f"{returns_in(batch):.1f}"})
        bar.update(min(batch.numel(), frames - done))
        done += batch.numel()
        if done >= frames:
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
        set_seed(env, EVALUATION_SEED)
        with set_exploration_type(how):
            returns[name] = returns_in(env.rollout(HORIZON, actor, break_when_any_done=False))
    return returns


def run_arm(name: str, seed: int, args: Namespace) -> dict[str, dict[str, float]]:
    """Train and evaluate an arm; returns its mean returns by delay, and by how the policy acts."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    arm, actor = ARMS[name], None
    if arm:
        with tqdm(total=args.frames, desc=f"seed {seed} {name}") as bar:
            actor = train(arm, seed, args.frames, bar)
    return {each: evaluate(arm or Arm(), actor, law, args.episodes) for each, law in EVALUATED.items()}


def table(results: Results, args: Namespace) -> str:
    """Write the results as results.csv and table.md; returns the latter's text."""
    with (args.out / "results.csv").open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["arm", "delay", "seed", *ACTING])
        for (arm, seed), returns in results.items():
            for delay, found in returns.items():
                rows.writerow([arm, delay, seed, *(f"{found[name]:.2f}" for name in ACTING)])
    parts = [
        f"# simple_spread_v3, MAPPO, {args.frames} steps: returns",
        f"Mean of {args.episodes} episodes and {len(args.seeds)} seeds (smallest and largest of a seed), "
        "by delay [steps]. Recovery: (arm - naive) / (undelayed without delay - naive).",
    ]
    for how in ACTING:
        lines = []
        for arm in args.arms:
            found = [[results[arm, s][delay][how] for s in args.seeds] for delay in EVALUATED]
            cells = [f"{statistics.mean(x):.1f} ({min(x):.1f}, {max(x):.1f})" for x in found]
            lines.append([arm, *cells, recovery(results, args, arm, how)])
        lines += [[f"{arm}, published", *map(str, known), ""] for arm, known in PUBLISHED.items()]
        parts += [f"## Actions: {how}", markdown_table(["arm", *EVALUATED, "recovery"], lines)]
    text = "\n\n".join(parts) + "\n"
    (args.out / "table.md").write_text(text, encoding="utf-8")
    return text


def recovery(results: Results, args: Namespace, arm: str, how: str) -> str:
    """(arm - naive) / (undelayed - naive) of an arm that is trained under the delay; empty for others."""
    if arm in ("random", "undelayed") or not {"undelayed", "naive"} <= {*args.arms}:
        return ""
    compared = ((arm, TRAINED), ("naive", TRAINED), ("undelayed", "0"))
    means = [statistics.mean(results[name, s][delay][how] for s in args.seeds) for name, delay in compared]
    own, naive, undelayed = means
    return f"{(own - naive) / (undelayed - naive):.0%}" if undelayed != naive else ""


def main(words: list[str] | None = None) -> None:
    """Train, evaluate and print the table."""
    options = parser("MAPPO in simple_spread_v3 with late observations.", list(ARMS), "runs/spread")
    options.add_argument("--frames", type=int, default=1_000_000, help="training steps of each arm")
    options.add_argument("--episodes", type=int, default=1000, help="episodes of each evaluation")
    args = options.parse_args(words)
    print(table(carried_out(args, run_arm), args))


if __name__ == "__main__":
    main()
