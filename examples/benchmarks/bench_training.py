"""Time of collecting, back-updating and optimising in a training iteration, beside TorchRL's MAPPO
on VMAS.

The training part of ``bench.py``. All methods have the same batch size, number of epochs and layer
widths. They take turns, iteration by iteration, so that a busy machine slows all of them.

    python examples/benchmarks/bench_training.py --seeds 3     (make bench-training)

trains until a return is reached, on crowded ground, and beside it TorchRL's MAPPO on the same
environment, and that of BenchMARL where it is installed.
"""

import importlib.util
import math
import statistics
import time
from argparse import ArgumentParser
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import NamedTuple, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import EnvBase
from torchrl.envs.libs.vmas import VmasEnv
from torchrl.modules import MultiAgentMLP, ProbabilisticActor, TanhNormal
from torchrl.modules.distributions import NormalParamExtractor
from torchrl.objectives.multiagent import MAPPOLoss
from torchrl.objectives.utils import ValueEstimators
from tqdm import tqdm

from damian import keys
from damian.common.tables import markdown_table
from damian.learners.mappo import Mappo, MappoConfig, add_advantages
from damian.learners.schedule import SystemClock
from damian.recipes.cli import settings as composed_config
from damian.recipes.config import TrainConfig
from damian.recipes.shared.learning import (
    learning_env,
    make_collector,
    make_learner,
    replay_buffer,
    ticks,
)

OBSERVED = ("agents", "observation")
RIVAL = "TorchRL and VMAS: MAPPO, one value for all"
RIVALS = {RIVAL: True, "TorchRL and VMAS: IPPO, a value for each": False}
"""Is one value computed for all agents, as with our ``model.shared_value``?"""
WIDTHS = {"2 x 64": [64, 64], "2 x 256": [256, 256]}
"""Layer widths of all networks, by name."""
UNDELAYED = "scenario=paper/usecase2"
AWARE = "scenario=paper/usecase2 delay=paper aware=backupdate+history"
COMPILED = "compile=true"
SHARED = "compile=true model.shared_value=true"
METHODS = (
    UNDELAYED,
    f"{UNDELAYED} {COMPILED}",
    f"{UNDELAYED} {SHARED}",
    AWARE,
    f"{AWARE} {SHARED}",
)
"""Overrides of ``damian train``, separated by spaces."""
PRODUCTS = "the matrix products of the first one's update alone"
"""What no update can be faster than, on this processor and with these networks."""
HEADER = ("training", "frames/s", "collecting [ms]", "back-updating [ms]", "optimising [ms]")
HEADER += ("back-updating's share", "times TorchRL and VMAS")
WARM_UP = (
    2  # iterations that do not count: the first compiles; back-updating has a full buffer after two
)


class Seconds(NamedTuple):
    """Times of the parts of one training iteration [s]."""

    collecting: float
    backupdating: float
    optimising: float  # with the advantages


def training(worlds: int, steps: int, repeats: int) -> list[tuple[str, ...]]:
    """Rows under ``HEADER``: medians of ``repeats`` iterations of each, with batches
    [worlds, steps]."""
    found = []
    for width, hidden in WIDTHS.items():
        methods = {words: damian(method_config(words, hidden, worlds, steps)) for words in METHODS}
        methods[PRODUCTS] = products(method_config(UNDELAYED, hidden, worlds, steps))
        if importlib.util.find_spec("vmas"):
            config = method_config(UNDELAYED, hidden, worlds, steps)
            methods |= {name: rival(config, together) for name, together in RIVALS.items()}
        times: dict[str, list[Seconds]] = {name: [] for name in methods}
        for _ in tqdm(range(WARM_UP + repeats), f"training, {width}", leave=False):
            for name, iterations in methods.items():
                times[name].append(next(iterations))
        parts = {name: zip(*measured[WARM_UP:], strict=True) for name, measured in times.items()}
        medians = {name: Seconds(*map(statistics.median, each)) for name, each in parts.items()}
        found += [(f"{width}: {name}", *cells) for name, *cells in rows(medians, worlds * steps)]
    return found


def rows(medians: dict[str, Seconds], frames: int) -> list[tuple[str, ...]]:
    """Rows under ``HEADER``, from median times of iterations with ``frames`` environment steps
    each."""
    totals = {name: sum(parts) for name, parts in medians.items()}
    return [
        (
            name,
            f"{frames / totals[name]:,.0f}",
            *(f"{1e3 * part:.0f}" for part in parts),
            f"{parts.backupdating / totals[name]:.1%}",
            f"{totals[RIVAL] / totals[name]:.2f}" if RIVAL in totals else "-",
        )
        for name, parts in medians.items()
    ]


def method_config(words: str, hidden: Sequence[int], worlds: int, steps: int) -> TrainConfig:
    """The configuration of a method: overrides, layer widths, and B and T of a batch."""
    batch = [
        f"worlds={worlds}",
        f"learner.steps={steps}",
        "learner.epochs=4",
        "learner.minibatches=4",
    ]
    return composed_config(*words.split(), f"model.hidden={list(hidden)}", *batch)


def damian(config: TrainConfig) -> Iterator[Seconds]:
    """Train as ``damian train`` does; yields the times of each iteration."""
    return (seconds for seconds, _ in damian_batches(config))


def damian_batches(config: TrainConfig) -> Iterator[tuple[Seconds, TensorDictBase]]:
    """Train as ``damian train`` does; yields the times and the steps of each iteration."""
    env = learning_env(config)
    clock = SystemClock(config.clock, config.update_steps)
    learner = cast(Mappo, make_learner(config, env, replay_buffer(config, env)))
    collector = make_collector(env, learner.actor, config.worlds * clock.unit, config.compile)
    batches = ticks(collector, clock, env.server)
    while True:
        begin = time.perf_counter()
        batch = next(batches)
        collected = time.perf_counter()
        batch = learner.backupdated_batch(batch)
        backupdated = time.perf_counter()
        add_advantages(batch, learner.critic, learner.config)
        learner.optimize(batch)
        yield (
            Seconds(collected - begin, backupdated - collected, time.perf_counter() - backupdated),
            batch,
        )


def products(config: TrainConfig) -> Iterator[Seconds]:
    """Multiply what the layers of an update multiply, forwards and backwards, and nothing else."""
    env = learning_env(config)
    learner = cast(MappoConfig, config.learner)
    networks = cast(Mappo, make_learner(config, env, replay_buffer(config, env)))
    n = config.worlds * config.update_steps * config.agents // learner.minibatches
    layers = [
        m.weight.data
        for net in (networks.actor, networks.critic)
        for m in net.modules()
        if isinstance(m, nn.Linear)
    ]
    inputs = [torch.rand(n, layer.shape[1]) for layer in layers]
    gradients = [torch.rand(n, layer.shape[0]) for layer in layers]
    while True:
        begin = time.perf_counter()
        for _ in range(learner.epochs * learner.minibatches):
            for layer, entered, gradient in zip(layers, inputs, gradients, strict=True):
                entered @ layer.T, gradient @ layer, gradient.T @ entered
        yield Seconds(0.0, 0.0, time.perf_counter() - begin)


def rival(config: TrainConfig, together: bool) -> Iterator[Seconds]:
    """Train on VMAS's navigation with TorchRL's own networks, loss and buffer; yields times of
    iterations.

    ``together``: compute one value for all agents (MAPPO) instead of one for each (IPPO).
    """
    options = {"n_agents": config.agents, "max_steps": 100, "continuous_actions": True}
    env = VmasEnv("navigation", num_envs=config.worlds, **options)
    actor = vmas_actor(env, config.agents, config.model.hidden)
    return (seconds for seconds, _ in mappo_batches(config, env, actor, together))


def mappo_batches(
    config: TrainConfig, env: EnvBase, actor: ProbabilisticActor, together: bool
) -> Iterator[tuple[Seconds, TensorDictBase]]:
    """Train with TorchRL's MAPPO, buffer and collector; yields the times and the steps of each
    iteration."""
    worlds = config.worlds
    steps = config.update_steps
    learner = cast(MappoConfig, config.learner)
    network = agent_network(env, config.agents, config.model.hidden, 1, together)
    observed = OBSERVED
    critic = TensorDictModule(network, in_keys=[observed], out_keys=[("agents", "state_value")])
    loss = MAPPOLoss(
        actor, critic, clip_epsilon=learner.clip_epsilon, entropy_coeff=learner.entropy_coeff
    )
    loss.set_keys(
        reward=("agents", "reward"), value=("agents", "state_value"), action=("agents", "action")
    )
    loss.set_keys(sample_log_prob=("agents", "action_log_prob"))
    loss.make_value_estimator(ValueEstimators.MAGAE, gamma=learner.gamma, lmbda=learner.lmbda)
    optimizer = torch.optim.Adam(loss.parameters(), lr=learner.lr)
    collector = Collector(env, actor, frames_per_batch=worlds * steps, total_frames=-1)
    storage = LazyTensorStorage(worlds * steps)
    size = worlds * steps // learner.minibatches
    memory = TensorDictReplayBuffer(
        storage=storage, sampler=SamplerWithoutReplacement(), batch_size=size
    )
    batches = iter(collector)
    while True:
        begin = time.perf_counter()
        batch = next(batches)
        collected = time.perf_counter()
        with torch.no_grad():
            loss.value_estimator(batch)
        memory.extend(batch.reshape(-1))
        for _ in range(learner.epochs):
            for minibatch in memory:
                losses = loss(minibatch)
                optimizer.zero_grad()
                (
                    losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
                ).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), learner.max_grad_norm)
                optimizer.step()
        collector.update_policy_weights_()
        yield Seconds(collected - begin, 0.0, time.perf_counter() - collected), batch


def vmas_actor(env: EnvBase, agents: int, hidden: Sequence[int]) -> ProbabilisticActor:
    """A policy with tanh-normal actions of each agent, from its own observation."""
    n_out = 2 * env.full_action_spec_unbatched["agents", "action"].shape[-1]
    network = nn.Sequential(
        agent_network(env, agents, hidden, n_out, False), NormalParamExtractor()
    )
    normal = [("agents", "loc"), ("agents", "scale")]
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=[OBSERVED], out_keys=normal),
        in_keys=normal,
        out_keys=[("agents", "action")],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0},
        return_log_prob=True,
        log_prob_key=("agents", "action_log_prob"),
    )


def agent_network(
    env: EnvBase, agents: int, hidden: Sequence[int], n_out: int, centralised: bool
) -> MultiAgentMLP:
    """One network for all agents."""
    n_in = env.observation_spec["agents", "observation"].shape[-1]
    options = {"share_params": True, "num_cells": list(hidden), "activation_class": nn.Tanh}
    return MultiAgentMLP(n_in, n_out, agents, centralized=centralised, **options)


# Until a return is reached.

TASK = "scenario=delaybench/crowded"
OURS = {"damian train": "compile=false", "damian train, compiled": "compile=true"}


def discrete_actor(env: EnvBase, config: TrainConfig) -> ProbabilisticActor:
    """A policy with discrete actions of each agent, from its own observation."""
    n_out = config.actions.n_actions
    network = agent_network(env, config.agents, config.model.hidden, n_out, False)
    logits = ("agents", "logits")
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=[OBSERVED], out_keys=[logits]),
        in_keys={"logits": logits},
        out_keys=[("agents", "action")],
        distribution_class=Categorical,
        return_log_prob=True,
        log_prob_key=("agents", "action_log_prob"),
    )


class Meter:
    """Processor time [s] and steps until the mean return of the episodes that a batch ends reaches
    ``goal``.

    Infinite if it does not within ``frames`` steps. Kernels that other processes compile do not
    count.
    """

    def __init__(self, goal: float, frames: int) -> None:
        self.goal = goal
        self.frames = frames
        self.steps = 0
        self.begin = time.process_time()

    def after(self, batch: TensorDictBase) -> tuple[float, int] | None:
        """Processor time and steps if the training has ended with this batch, else None."""
        self.steps += batch.numel()
        over = batch["next", "done"].squeeze(-1)
        if over.any() and batch[keys.next_key(keys.EPISODE_REWARD)][over].mean() >= self.goal:
            return time.process_time() - self.begin, self.steps
        return (math.inf, self.steps) if self.steps >= self.frames else None


def until(batches: Iterator[tuple[Seconds, TensorDictBase]], meter: Meter) -> tuple[float, int]:
    """Processor time and steps until the goal."""
    return next(found for _, batch in batches if (found := meter.after(batch)))


def to_a_return(goal: float, seeds: int, frames: int) -> str:
    """Processor time and steps until trainings without delay reach a return, median
    (least, most)."""
    found: dict[str, list[tuple[float, int]]] = defaultdict(list)
    for seed in tqdm(range(seeds), "seeds"):
        for name, words in OURS.items():
            torch.manual_seed(seed)
            config = composed_config(TASK, words, f"seed={seed}")
            meter = Meter(goal, frames)
            found[name].append(until(damian_batches(config), meter))
        config = composed_config(TASK, f"seed={seed}")
        torch.manual_seed(seed)
        meter = Meter(goal, frames)
        env = learning_env(config)
        rival = mappo_batches(config, env, discrete_actor(env, config), True)
        found["TorchRL's MAPPO, the same environment"].append(until(rival, meter))
        if importlib.util.find_spec("benchmarl"):
            rival_until = importlib.import_module("until").until
            found["BenchMARL's, the same"].append(
                rival_until(config, [TASK], Meter(goal, frames).after)
            )
    rows = []
    for name, runs in found.items():
        cells = [(statistics.median(x), min(x), max(x)) for x in zip(*runs, strict=True)]
        rows.append(
            (name, *(f"{middle:,.0f} ({least:,.0f}, {most:,.0f})" for middle, least, most in cells))
        )
    header = ("training", "processor time [s]", "steps")
    return f"Until a mean return of {goal:g}, {seeds} seeds\n\n" + markdown_table(header, rows)


if __name__ == "__main__":
    options = ArgumentParser(description="Time until trainings reach a return, on one core.")
    options.add_argument(
        "--goal", type=float, default=28.0, help="mean return of episodes, undelayed"
    )
    options.add_argument("--seeds", type=int, default=3)
    options.add_argument(
        "--frames", type=int, default=2_000_000, help="steps after which a training has failed"
    )
    torch.set_num_threads(1)
    print(to_a_return(**vars(options.parse_args())))
