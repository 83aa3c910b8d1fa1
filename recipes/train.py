"""Train UAVs with MAPPO or SAC, and show what they have learnt beside a random policy.

    python recipes/train.py agents=3 scenario=spotting motion=polynomial seed=1
    python recipes/train.py +usecase=2 delay=paper aware=both
    python recipes/train.py algo=sac scenario=tracking actions=continuous
    python recipes/train.py -m seed=0,1,2 agents=3,5
    python recipes/train.py resume=runs/2026-01-31_12-00-00

The run folder explains itself: config.yaml, metrics.csv, TensorBoard events, checkpoint,
learning_curve.png, result.csv, result.md.
"""

import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from shared.launch import launch, load, perform, prepare, reported, save_config
from shared.settings import CONF, TrainConfig
from tensordict import TensorDictBase
from torchrl.checkpoint import Checkpoint, GlobalRNGState
from torchrl.collectors import Collector
from torchrl.data import ReplayBuffer
from torchrl.envs import RewardSum, StepCounter, TransformedEnv
from tqdm import tqdm

from damian.baselines.greedy import greedy_policy
from damian.baselines.random import random_policy
from damian.envs.clocks import SystemClock
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env, messages_are_late
from damian.evaluation.comparison import GREEDY, MODE, RANDOM, SAMPLED
from damian.evaluation.metrics import EpisodeLog, Evaluation, evaluate
from damian.evaluation.run_folder import (
    CHECKPOINT,
    CONFIG,
    FIGURE,
    Interrupt,
    MetricsLog,
    plot_learning_curve,
    save_results,
)
from damian.learners.mappo import Mappo
from damian.learners.recurrent import prime
from damian.learners.sac import Sac
from damian.replay.backupdate import BackupdateStorage, TimeStorage, server_view
from damian.server.features import Snapshot


@dataclass
class Progress:
    """How far a run has come; part of its checkpoint."""

    frames: int = 0
    updates: int = 0

    def state_dict(self) -> dict[str, int]:
        return {"frames": self.frames, "updates": self.updates}

    def load_state_dict(self, state: dict[str, int]) -> None:
        self.frames, self.updates = int(state["frames"]), int(state["updates"])


def learning_env(config: TrainConfig) -> DelayedEnv:
    """The environment that policies are trained in."""
    read = looks_back(config) or config.clock.trigger is not None
    extras = ["reward_terms", *["message"] * read, *["privileged"] * (config.critic == "privileged")]
    env = make_env(config.learnt, config.worlds, config.seed, config.device, extras)
    if config.compile:
        env.compile()
    episode_reward = RewardSum(in_keys=[("agents", "reward")], out_keys=[("agents", "episode_reward")])
    env.append_transform(episode_reward)
    env.append_transform(StepCounter())
    return env


def looks_back(config: TrainConfig) -> bool:
    """Is there anything to correct, and should it be."""
    return config.backupdate and messages_are_late(config)


def make_learner(config: TrainConfig, env: DelayedEnv, clock: SystemClock) -> Mappo | Sac:
    """The algorithm, on a memory in which late messages correct what is learnt from if they should."""
    settle = config.longest_delay if config.settle else 0
    if config.algo == "mappo":
        shortest = (clock.longest + 2 * config.longest_delay) * config.worlds
        memory = make_memory(config, env, shortest) if looks_back(config) else None
        seen, recompute = config.critic_sees, config.recompute_actor
        return Mappo(env, config.model, config.mappo, memory, settle, recompute, seen)
    memory = make_memory(config, env, config.sac.memory // config.worlds * config.worlds)
    return Sac(env, config.model, config.sac, memory, settle, config.critic_sees)


def make_memory(config: TrainConfig, env: DelayedEnv, capacity: int) -> ReplayBuffer:
    """What keeps the latest steps of the worlds, so many in all."""
    if not looks_back(config):
        return ReplayBuffer(storage=TimeStorage(capacity, device=config.device))
    view = server_view(env.worlds.server, actor=config.recompute_actor)
    storage = BackupdateStorage(capacity, view, config.longest_delay, device=config.device)
    return ReplayBuffer(storage=storage)


def make_collector(env: TransformedEnv, actor: torch.nn.Module, frames: int) -> Collector:
    """Collects batches of so many steps, without end."""
    prime(env, actor)
    return Collector(
        env, actor, frames_per_batch=frames, total_frames=-1, auto_register_policy_transforms=True
    )


def ticks(collector: Collector, clock: SystemClock) -> Iterator[TensorDictBase]:
    """What was collected between two ticks of the system clock, [B, T]."""
    parts: list[TensorDictBase] = []
    for part in collector:
        parts.append(part)
        if sum(part.shape[1] for part in parts) < clock.period:
            continue
        batch = cast(TensorDictBase, torch.cat(parts, 1)) if len(parts) > 1 else part  # type: ignore[arg-type]
        if clock.change:
            clock.tick(spotting(batch))
        parts = []
        yield batch


def spotting(batch: TensorDictBase) -> torch.Tensor:
    """Which UAVs spot the source after a batch [B, T], as the server knows, [B, N]."""
    agents = cast(TensorDictBase, batch["next", "agents"][:, -1])
    return Snapshot.unpack(agents.get("received", agents["message"])).spotted


def train(config: TrainConfig, folder: Path) -> None:
    """Learn, then evaluate and fill the run folder.

    Raises:
        InputError: it cannot be learnt like this, or what there is cannot be loaded.
    """
    config.check_learning()
    env, clock = learning_env(config), SystemClock(config.clock, config.update_steps)
    learner = make_learner(config, env, clock)
    progress, episodes = Progress(), EpisodeLog()
    state = {"progress": progress, "episodes": episodes, "clock": clock, "rng": GlobalRNGState()}
    checkpoint = Checkpoint(**learner.parts(), **state)
    if config.resume:
        load(checkpoint, folder, "resume")
        env.set_seed(config.seed + 1_000_003 * progress.updates)  # not the first episodes once more
    elif config.checkpoint:
        load(
            checkpoint, Path(config.checkpoint), "checkpoint", ["actor", *["critic"] * same_algorithm(config)]
        )
    save_config(config, folder)
    log = MetricsLog(folder, config.logger.tensorboard, config.logger.csv, progress.frames)
    collector = make_collector(env, learner.actor, config.worlds * clock.unit)
    bar = progress_bar(config, progress, episodes)
    with closing(log), closing(bar), Interrupt() as interrupt:
        for batch in ticks(collector, clock) if not enough(config, progress, episodes) else ():
            episodes.add(batch)
            losses = learner.learn(batch)
            progress.frames += batch.numel()
            progress.updates += 1
            means = {"episodes": float(episodes.finished), **episodes.means()}
            log.add(progress.frames, {**means, **mean_terms(batch), **losses})
            bar.set_postfix({name: f"{mean:.2f}" for name, mean in episodes.means().items()})
            bar.update((episodes.finished if config.episodes else progress.frames) - bar.n)
            over = enough(config, progress, episodes) or interrupt.asked
            if over or progress.updates % config.checkpoint_every == 0:
                checkpoint.save(folder / CHECKPOINT)
            if over:
                break
    collector.shutdown()
    if interrupt.asked:
        sys.exit(f"interrupted; go on with resume={folder}")
    random = report(config, folder, unseen(config), learner.actor)
    plot_learning_curve(log.rows, random, folder / FIGURE, f"{config.agents} UAVs, {config.algo.upper()}")
    print(f"learning curve: {folder / FIGURE}")


def same_algorithm(config: TrainConfig) -> bool:
    """Has the policy to begin with been learnt by the same algorithm, so that its critic fits?"""
    saved = Path(str(config.checkpoint)) / CONFIG
    stored = cast(DictConfig, OmegaConf.load(saved)) if saved.is_file() else {}
    return stored.get("algo", config.algo) == config.algo


def progress_bar(config: TrainConfig, progress: Progress, episodes: EpisodeLog) -> tqdm:
    """Counts what the run is measured in."""
    if config.episodes:
        return tqdm(total=config.episodes, initial=episodes.finished, unit=" episodes")
    return tqdm(total=config.frames, initial=progress.frames, unit=" steps", unit_scale=True)


def enough(config: TrainConfig, progress: Progress, episodes: EpisodeLog) -> bool:
    """Has the run lasted as long as it should?"""
    return progress.frames >= config.frames or episodes.finished >= (config.episodes or torch.inf)


def mean_terms(batch: TensorDictBase) -> dict[str, float]:
    """Mean of each weighted reward term, over steps, worlds and UAVs."""
    terms = cast(TensorDictBase, batch["next", "agents", "reward_terms"])
    return {f"reward/{name}": term.mean().item() for name, term in terms.items()}


def unseen(config: TrainConfig) -> DelayedEnv:
    """An environment of situations that were not trained on, a world for each episode of an evaluation."""
    return make_env(config.flown, config.eval_episodes, config.unseen_seed, config.device, ["message"])


def report(config: TrainConfig, folder: Path, env: DelayedEnv, actor: torch.nn.Module) -> Evaluation:
    """Evaluate an actor; results into the folder, and a table to read.

    Returns:
        what a random policy comes to.
    """

    def fly(policy: torch.nn.Module, sample: bool = True) -> Evaluation:
        env.set_seed(config.unseen_seed)  # the same episodes for every policy
        return evaluate(env, policy, config.horizon, sample)

    random = fly(random_policy(env))
    rows = {SAMPLED: fly(actor), MODE: fly(actor, False), RANDOM: random, GREEDY: fly(greedy_policy(env))}
    table = save_results(rows, folder, config.episode.success_share is not None, messages_are_late(config))
    print(f"\n{table}\n")
    return random


@hydra.main(version_base=None, config_path=CONF, config_name="train")
@reported
def main(written: DictConfig) -> None:
    perform(*prepare(written), train)


if __name__ == "__main__":
    launch(main)
