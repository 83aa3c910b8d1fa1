"""Compare with a published table: MAPPO in PettingZoo's simple_spread_v3 or simple_tag_v3, observed
late.

    python examples/studies/spread.py    (an hour on one core; --jobs 2 takes two)
    python examples/studies/spread.py --game tag --methods undelayed naive registered+backupdate
    python examples/studies/spread.py --delay 6 12 --out runs/spread_6_12
    python examples/studies/spread.py --seeds 0 --frames 100000 --out runs/spread0

Three agents cover three landmarks, or catch a prey, in episodes of 25 steps; the return is the sum
of all agents' rewards. An agent knows its own velocity and position at once; it sees each landmark,
each other agent and the prey late, and begins with what it sees at the beginning. Methods: random
actions; undelayed, trained without delay; and, trained while each of these messages takes 3 to 9
steps, naive, backupdate, and those whose actors also observe the ages of what they see and their
own latest actions. Of these

- registered moves what is seen into the agent's present frame, by the agent's own way since then;
- buffer, the same, holds it until it is as old as the longest delay in training (a jitter buffer);
- timeline shows all that has arrived of the latest steps, registered, by when it was true
  (``ObservationTimeline``).

With backupdate the critic learns from what has arrived since (``BackupdateStorage``), with gru the
actor has a memory;
undelayed+registered acts as undelayed does, but is flown late with what is registered. Each policy
is evaluated under several delays, by its most likely actions, in episodes that begin alike for all.

The folder gets results.csv, a row for each method, delay and seed, the means as table.md beside
those published (Fu et al. 2025, "Rainbow Delay Compensation", arXiv 2505.03586), and a JSON file
for each method and seed.
"""

import csv
import math
import statistics
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeVar, cast

import torch
from particles import (
    AGES,
    DELAYS,
    HELD,
    HORIZON,
    KINEMATICS,
    PAST,
    SEEN,
    SimpleSpread,
    SimpleTag,
    late_game,
    observed,
)
from study import Results, carried_out, parser
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor
from tqdm import tqdm

from damian import keys, set_seed
from damian.common.tables import markdown_table
from damian.delays.laws import Uniform
from damian.keys import next_key
from damian.learners.base import LearningSetup
from damian.learners.mappo import Mappo, MappoConfig
from damian.models.config import MlpConfig, ModelConfig
from damian.models.memory import add_recurrent_state
from damian.replay.backupdate import BackupdateStorage, corrections_of
from damian.transforms.base import Correction
from damian.transforms.entries import Entries

Network = TypeVar("Network", bound=nn.Module)
Delays = tuple[int, int]
"""The shortest and the longest delay of a message [steps]; all between are equally likely."""
NONE: Delays = (0, 0)
EVALUATED: tuple[Delays, ...] = (*((d, d) for d in (0, 3, 6, 9, 12)), (3, 9), (6, 12))
"""The delays under which policies are evaluated, beside those of the training."""


class Method(NamedTuple):
    """What a policy is trained with."""

    delayed: bool = True
    """Whether messages are late in training."""
    history: bool = False
    """Whether the actor observes the age of what it sees, and its own latest actions."""
    registered: bool = False
    """Whether what agents see is moved into their present frame."""
    buffer: bool = False
    """Whether each message is held until it is as old as the longest delay in training."""
    timeline: bool = False
    """Whether agents observe timelines."""
    backupdate: bool = False
    """Whether the critic learns from what has arrived since."""
    memory: bool = False
    """Whether the actor's last hidden layer is a gated recurrent unit."""

    @property
    def model(self) -> MlpConfig:
        """The networks."""
        return replace(MODEL, rnn="gru") if self.memory else MODEL


METHODS: dict[str, Method | None] = {
    "random": None,
    "undelayed": Method(delayed=False),
    "undelayed+registered": Method(delayed=False, registered=True),
    "naive": Method(),
    "backupdate": Method(backupdate=True),
    "registered": Method(history=True, registered=True),
    "registered+backupdate": Method(history=True, registered=True, backupdate=True),
    "registered+backupdate+gru": Method(
        history=True, registered=True, backupdate=True, memory=True
    ),
    "buffer": Method(history=True, registered=True, buffer=True),
    "timeline": Method(history=True, timeline=True),
    "timeline+backupdate": Method(history=True, timeline=True, backupdate=True),
}
PUBLISHED = {"undelayed": (-33.1, -37.6, -48.8, -59.9, -67.2), "random": (-82.4,)}
"""Published returns in simple_spread by method, under the first of the delays that are
evaluated."""
GAMES = {"spread": SimpleSpread, "tag": SimpleTag}

WORLDS = 256  # an update learns from one episode of each
MODEL = MlpConfig(hidden=[64, 64])
LEARNER: dict[str, Any] = {
    "steps": HORIZON,
    "lr": 5e-3,
    "gamma": 0.9,
    "lmbda": 0.95,
    "minibatches": 8,
}
LEARNER |= {"entropy_coeff": 0.003, "normalize_value": True}  # the bonus falls to 0 in the training
SLOTS = 13  # of a timeline: as old as the longest delay that is evaluated
EVALUATION_SEED = 1000  # of the initial conditions in every evaluation


def make_env(
    method: Method, worlds: int, delay: Delays, longest: int, game: str = "spread"
) -> TransformedEnv:
    """The environment of a method, under a delay; ``longest`` is the longest one in training."""
    low, high = (max(steps, longest) for steps in delay) if method.buffer else delay
    slots = SLOTS if method.timeline else 0
    late = {"aware": method.history, "registered": method.registered, "slots": slots}
    return late_game(GAMES[game], worlds, Uniform(low, high), longest, **late)


def recompute(method: Method, steps: TensorDictBase, blocks: Tensor) -> Entries:
    """What critics would have observed after steps [T, B], had these blocks [T, B, K, 2] arrived at
    once."""
    found = observed(steps[next_key(KINEMATICS)], blocks, method.registered)
    return {next_key(keys.GLOBAL_OBSERVATION): found}


def with_timelines(entries: Entries, steps: TensorDictBase, count: Tensor) -> Entries:
    """The same for critics of timelines, which ``ObservationTimeline`` has corrected."""
    found = observed(steps[next_key(KINEMATICS)], entries[next_key(PAST)])
    return entries | {next_key(keys.GLOBAL_OBSERVATION): found}


class OrthogonalMappo(MappoConfig):
    """MAPPO whose networks begin with orthogonal matrices and biases of 0 (Saxe et al. 2014)."""

    def make_actor(self, env: EnvBase, model: ModelConfig) -> ProbabilisticActor:
        return orthogonal(super().make_actor(env, model), 0.01)

    def make(self, env: EnvBase, setup: LearningSetup, buffer: ReplayBuffer | None) -> Mappo:
        learner = super().make(env, setup, buffer)
        orthogonal(learner.critic, 1.0)
        return learner


def orthogonal(network: Network, gain: float) -> Network:
    """Initialise the weights, with ``gain`` in the last layer."""
    layers = [each for each in network.modules() if isinstance(each, nn.Linear)]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, gain if layer is layers[-1] else math.sqrt(2))
        nn.init.zeros_(layer.bias)
    return network


def make_learner(env: TransformedEnv, method: Method, longest: int) -> Mappo:
    """The learner that also trains UAVs: MAPPO, with back-updating if the method says so."""
    config = OrthogonalMappo(**LEARNER)
    late = {"backupdate": method.backupdate, "settle": method.backupdate}
    setup = LearningSetup(method.model, WORLDS, HORIZON, HORIZON, longest, **late)
    size = config.buffer_size(setup)
    if size is None:
        return config.make(env, setup, None)
    corrections = corrections_of(env.transform, [PAST])
    corrections += [Correction(with_timelines)] * len(corrections)
    size += WORLDS * sum(correction.lookback for correction in corrections)
    names = {"message_key": SEEN, "received_key": HELD, "delay_key": DELAYS, "age_key": AGES}
    storage = BackupdateStorage(
        size, partial(recompute, method), longest, corrections=corrections, **names
    )
    return config.make(env, setup, ReplayBuffer(storage=storage))


def train(method: Method, seed: int, args: Namespace, bar: tqdm) -> nn.Module:
    """Train for at least ``args.frames`` environment steps; returns the policy."""
    frames = args.frames
    longest = args.delay[1]
    env = make_env(
        method, WORLDS, tuple(args.delay) if method.delayed else NONE, longest, args.game
    )
    set_seed(env, seed)
    learner = make_learner(env, method, longest)
    done = 0
    add_recurrent_state(env, learner.actor)
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
        first = LEARNER["entropy_coeff"]
        learner.config.entropy_coeff = first - first * min(done / frames, 1.0)
        if done >= frames:
            break
    collector.shutdown()
    return learner.actor


def returns_in(batch: TensorDictBase) -> float:
    """Mean return of the episodes in a batch [B, HORIZON]."""
    return cast(Tensor, batch[next_key(keys.REWARD)]).flatten(1).sum(1).mean().item()


@torch.no_grad()
def evaluate(env: TransformedEnv, actor: nn.Module | None) -> float:
    """Mean return of the most likely actions, in episodes that begin alike at every call."""
    if actor:
        add_recurrent_state(env, actor)
    set_seed(env, EVALUATION_SEED)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return returns_in(env.rollout(HORIZON, actor, break_when_any_done=False))


def run_method(name: str, seed: int, args: Namespace) -> dict[str, float]:
    """Train and evaluate a method; returns its mean returns by delay."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    method, actor, (low, high) = METHODS[name], None, args.delay
    if method:
        with tqdm(total=args.frames, desc=f"seed {seed} {name}") as bar:
            actor = train(method, seed, args, bar)
    return {
        named(delay): evaluate(
            make_env(method or Method(), args.episodes, delay, high, args.game), actor
        )
        for delay in dict.fromkeys((*EVALUATED, (low, high)))
    }


def named(delay: Sequence[int]) -> str:
    """How the table calls delays."""
    low, high = delay
    return f"{low} to {high}" if low < high else str(low)


def table(results: Results, args: Namespace) -> str:
    """Write the results as results.csv and table.md; returns the latter's text."""
    with (args.out / "results.csv").open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["method", "delay", "seed", "return"])
        for (method, seed), returns in results.items():
            rows.writerows(
                [method, delay, seed, f"{found:.2f}"] for delay, found in returns.items()
            )
    trained = named(args.delay)
    flown = list(next(iter(results.values())))

    def mean(method: str, delay: str) -> float:
        return statistics.mean(results[method, seed][delay] for seed in args.seeds)

    lines = []
    for method in args.methods:
        found = [[results[method, seed][delay] for seed in args.seeds] for delay in flown]
        cells = [f"{statistics.mean(x):.1f} ({min(x):.1f}, {max(x):.1f})" for x in found]
        recovered = ""
        if method not in ("undelayed", "random") and "undelayed" in args.methods:
            base = mean("undelayed", trained)
            best = mean("undelayed", "0")
            recovered = f"{(mean(method, trained) - base) / (best - base):.2f}"
        lines.append([method, *cells, recovered])
    if args.game == "spread":
        for method, returns in PUBLISHED.items():
            blank = [""] * (len(flown) + 1 - len(returns))
            lines.append([f"{method}, published", *map(str, returns), *blank])
    text = (
        f"# simple_{args.game}_v3, MAPPO, {args.frames} steps, delays of {trained}: returns\n\n"
        f"Mean of {args.episodes} episodes and {len(args.seeds)} seeds (smallest and largest of a "
        "seed), by "
        f"delay [steps]. Recovery under {trained}: (method - base) / (undelayed without delay - "
        "base); the "
        "base is undelayed, flown "
        f"late.\n\n{markdown_table(['method', *flown, 'recovery'], lines)}\n"
    )
    (args.out / "table.md").write_text(text, encoding="utf-8")
    return text


def main(words: list[str] | None = None) -> None:
    """Train, evaluate and print the table."""
    options = parser(
        "MAPPO in games of PettingZoo with late observations.", list(METHODS), "runs/spread"
    )
    options.add_argument(
        "--game", choices=GAMES, default="spread", help="simple_spread or simple_tag"
    )
    options.add_argument(
        "--delay",
        type=int,
        nargs=2,
        default=[3, 9],
        metavar=("LOW", "HIGH"),
        help="delays in training [steps]",
    )
    options.add_argument(
        "--frames", type=int, default=1_000_000, help="training steps of each method"
    )
    options.add_argument("--episodes", type=int, default=1000, help="episodes of each evaluation")
    args = options.parse_args(words)
    print(table(carried_out(args, run_method), args))


if __name__ == "__main__":
    main()
