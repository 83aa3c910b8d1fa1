"""Time of collecting, back-updating and optimising in a training iteration, beside TorchRL's MAPPO on VMAS.

This is the training part of ``recipes/bench.py``, which runs it; it has no command line of its own. All arms
have the same batch size, number of epochs and layer widths. They take turns, iteration by iteration, so that
a busy machine slows all of them.
"""

import importlib.util
import statistics
import time
from collections.abc import Iterator
from typing import NamedTuple, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import EnvBase, RewardSum, TransformedEnv
from torchrl.envs.libs.vmas import VmasEnv
from torchrl.modules import MultiAgentMLP, ProbabilisticActor, TanhNormal
from torchrl.modules.distributions import NormalParamExtractor
from torchrl.objectives.multiagent import MAPPOLoss
from torchrl.objectives.utils import ValueEstimators
from tqdm import tqdm

from damian.learners.mappo import Mappo, MappoConfig, add_advantages
from damian.learners.schedule import SystemClock

from .shared.collecting import make_collector, ticks
from .shared.launch import composed_config
from .shared.learning_env import learning_env
from .shared.settings import TrainConfig
from .train import make_learner, replay_buffer

RIVAL = "TorchRL and VMAS: MAPPO, one value for all"
RIVALS = {RIVAL: True, "TorchRL and VMAS: IPPO, a value for each": False}
"""Is one value computed for all agents, as with our ``model.shared_value``?"""
WIDTHS = {"2 x 64": "model.hidden=[64,64]", "2 x 256": "model.hidden=[256,256]"}
"""Overrides for the layer widths of all networks, by name."""
UNDELAYED = "scenario=paper/usecase2"
AWARE = f"{UNDELAYED} delay=paper aware=both"
COMPILED = "compile=true"
SHARED = f"{COMPILED} model.shared_value=true"
ARMS = (UNDELAYED, f"{UNDELAYED} {COMPILED}", f"{UNDELAYED} {SHARED}", AWARE, f"{AWARE} {SHARED}")
"""Overrides of ``damian train``, separated by spaces."""
HEADER = (
    "training",
    "frames/s",
    "collecting [ms]",
    "back-updating [ms]",
    "optimising [ms]",
    "back-updating's share",
    "times TorchRL and VMAS",
)
WARM_UP = 2
"""Iterations that do not count: the first one compiles, and back-updating has a full replay buffer from the
second on."""


class Seconds(NamedTuple):
    """Times of the parts of one training iteration [s]."""

    collecting: float
    backupdating: float
    optimising: float
    """With the advantages."""


def training(worlds: int, steps: int, repeats: int) -> list[tuple[str, ...]]:
    """Rows under ``HEADER``: medians of ``repeats`` iterations of each arm, with batches [worlds, steps]."""
    return [
        (f"{width}: {name}", *cells)
        for width, hidden in WIDTHS.items()
        for name, *cells in rows(in_turn(hidden, worlds, steps, repeats), worlds * steps)
    ]


def in_turn(hidden: str, worlds: int, steps: int, repeats: int) -> dict[str, Seconds]:
    """Median times of each arm and rival, by name; ``hidden``: an override for the layer widths."""
    arms = {words: damian(arm_config(f"{words} {hidden}", worlds, steps)) for words in ARMS}
    if importlib.util.find_spec("vmas"):
        config = arm_config(f"{UNDELAYED} {hidden}", worlds, steps)
        arms |= {name: rival(config, together) for name, together in RIVALS.items()}
    times: dict[str, list[Seconds]] = {name: [] for name in arms}
    for _ in tqdm(range(WARM_UP + repeats), f"training, {hidden}", leave=False):
        for name, iterations in arms.items():
            times[name].append(next(iterations))
    return {name: median(measured[WARM_UP:]) for name, measured in times.items()}


def arm_config(words: str, worlds: int, steps: int) -> TrainConfig:
    """The configuration of an arm.

    Args:
        words: overrides of ``damian train``, separated by spaces.
        worlds: B of a batch.
        steps: T of a batch.
    """
    batch = [f"worlds={worlds}", f"learner.steps={steps}", "learner.epochs=4", "learner.minibatches=4"]
    return composed_config(*words.split(), *batch)


def damian(config: TrainConfig) -> Iterator[Seconds]:
    """Train as ``damian train`` does; yields the times of each iteration."""
    env, clock = learning_env(config), SystemClock(config.clock, config.update_steps)
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
        yield Seconds(collected - begin, backupdated - collected, time.perf_counter() - backupdated)


def rival(config: TrainConfig, together: bool) -> Iterator[Seconds]:
    """Train on VMAS with TorchRL's own networks, loss and replay buffer; yields the times of each iteration.

    ``together``: compute one value for all agents (MAPPO) instead of one for each (IPPO).
    """
    worlds, steps, learner = config.worlds, config.update_steps, cast(MappoConfig, config.learner)
    env = vmas_env(worlds, config.agents)
    actor, critic = vmas_actor(env, config), vmas_critic(env, config, together)
    loss = vmas_loss(actor, critic, learner)
    optimizer = torch.optim.Adam(loss.parameters(), lr=learner.lr)
    collector = make_collector(env, actor, worlds * steps)
    memory = TensorDictReplayBuffer(
        storage=LazyTensorStorage(worlds * steps),
        sampler=SamplerWithoutReplacement(),
        batch_size=worlds * steps // learner.minibatches,
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
                descend(loss, optimizer, minibatch, learner.max_grad_norm)
        collector.update_policy_weights_()
        yield Seconds(collected - begin, 0.0, time.perf_counter() - collected)


def vmas_env(worlds: int, agents: int) -> TransformedEnv:
    """VMAS's navigation task, in which each agent looks for its own goal with a lidar."""
    env = VmasEnv("navigation", num_envs=worlds, n_agents=agents, max_steps=100, continuous_actions=True)
    return TransformedEnv(env, RewardSum([("agents", "reward")], [("agents", "episode_reward")]))


def vmas_actor(env: EnvBase, config: TrainConfig) -> ProbabilisticActor:
    """A policy with tanh-normal actions of each agent, from its own observation."""
    spec = env.full_action_spec_unbatched["agents", "action"]
    network = vmas_network(env, config, n_out=2 * spec.shape[-1], centralised=False)
    return ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(network, NormalParamExtractor()),
            in_keys=[("agents", "observation")],
            out_keys=[("agents", "loc"), ("agents", "scale")],
        ),
        in_keys=[("agents", "loc"), ("agents", "scale")],
        out_keys=[("agents", "action")],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0},
        return_log_prob=True,
        log_prob_key=("agents", "action_log_prob"),
    )


def vmas_critic(env: TransformedEnv, config: TrainConfig, together: bool) -> TensorDictModule:
    """A value for each agent from its own observation, or one for all agents from all observations."""
    network = vmas_network(env, config, n_out=1, centralised=together)
    return TensorDictModule(
        network, in_keys=[("agents", "observation")], out_keys=[("agents", "state_value")]
    )


def vmas_network(env: EnvBase, config: TrainConfig, n_out: int, centralised: bool) -> MultiAgentMLP:
    """One network for all agents, with the layer widths of ``config.model``."""
    return MultiAgentMLP(
        n_agent_inputs=env.observation_spec["agents", "observation"].shape[-1],
        n_agent_outputs=n_out,
        n_agents=config.agents,
        centralized=centralised,
        share_params=True,
        num_cells=config.model.hidden,
        activation_class=nn.Tanh,
    )


def vmas_loss(actor: ProbabilisticActor, critic: TensorDictModule, config: MappoConfig) -> MAPPOLoss:
    """TorchRL's MAPPO loss with the TensorDict keys of VMAS."""
    loss = MAPPOLoss(actor, critic, clip_epsilon=config.clip_epsilon, entropy_coeff=config.entropy_coeff)
    loss.set_keys(reward=("agents", "reward"), value=("agents", "state_value"))
    loss.make_value_estimator(ValueEstimators.MAGAE, gamma=config.gamma, lmbda=config.lmbda)
    return loss


def descend(
    loss: MAPPOLoss, optimizer: torch.optim.Optimizer, steps: TensorDictBase, max_norm: float
) -> None:
    """One optimiser step on a minibatch [M] of environment steps."""
    losses = loss(steps)
    total = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
    optimizer.zero_grad()
    cast(torch.Tensor, total).backward()
    nn.utils.clip_grad_norm_(loss.parameters(), max_norm)
    optimizer.step()


def median(measured: list[Seconds]) -> Seconds:
    """The median of each part, taken by itself."""
    return Seconds(*map(statistics.median, zip(*measured, strict=True)))


def rows(medians: dict[str, Seconds], frames: int) -> list[tuple[str, ...]]:
    """Rows under ``HEADER``, from median times of iterations with ``frames`` environment steps each."""
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
