"""Train UAVs with MAPPO, and show what they have learnt beside a random policy.

    python recipes/train.py agents=3 scenario=spotting motion=polynomial seed=1
    python recipes/train.py +usecase=2
    python recipes/train.py -m seed=0,1,2 agents=3,5
    python recipes/train.py resume=runs/2026-01-31_12-00-00

The run folder explains itself: config.yaml, metrics.csv, TensorBoard events, checkpoint,
learning_curve.png, result.md.
"""

import sys
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import hydra
import torch
from launch import CONF, TrainConfig, launch, load, prepare, reported, save_config
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.checkpoint import Checkpoint, GlobalRNGState
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import RewardSum, StepCounter
from torchrl.objectives.multiagent import MAPPOLoss
from tqdm import tqdm

from damian.chain import DelayedEnv
from damian.delayed import make_env, messages_are_late
from damian.delays import law_of
from damian.losses import MappoConfig, add_advantages, losses_of, mappo_loss
from damian.metrics import EpisodeLog, Evaluation, evaluate
from damian.models import make_actor, make_critic, random_policy
from damian.runs import (
    CHECKPOINT,
    FIGURE,
    Interrupt,
    MetricsLog,
    plot_learning_curve,
    results_table,
)
from damian.storage import BackupdateStorage, server_view


@dataclass
class Progress:
    """How far a run has come; part of its checkpoint."""

    frames: int = 0
    updates: int = 0

    def state_dict(self) -> dict[str, int]:
        return {"frames": self.frames, "updates": self.updates}

    def load_state_dict(self, state: dict[str, int]) -> None:
        self.frames, self.updates = int(state["frames"]), int(state["updates"])


def learning_env(config: TrainConfig, worlds: int, seed: int) -> DelayedEnv:
    """The environment that policies are trained and evaluated in."""
    extras = ["reward_terms", "message"] if looks_back(config) else ["reward_terms"]
    env = make_env(config, worlds, seed, config.device, extras)
    if config.compile:
        env.compile()
    episode_reward = RewardSum(in_keys=[("agents", "reward")], out_keys=[("agents", "episode_reward")])
    env.append_transform(episode_reward)
    env.append_transform(StepCounter())
    return env


def looks_back(config: TrainConfig) -> bool:
    """Is there anything to correct, and should it be."""
    return config.backupdate and messages_are_late(config)


def make_memory(config: TrainConfig, env: DelayedEnv) -> TensorDictReplayBuffer | None:
    """What keeps the latest steps until late messages have arrived; None if nothing is corrected."""
    if not looks_back(config):
        return None
    longest = law_of(config.delay.obs).sampler(config.clock.dt).longest
    view = server_view(env.worlds.server, terms=True)
    capacity = (config.update_steps + 2 * longest) * config.worlds
    return TensorDictReplayBuffer(storage=BackupdateStorage(capacity, view, longest, device=config.device))


def known_now(memory: TensorDictReplayBuffer | None, batch: TensorDictBase) -> TensorDictBase:
    """A batch [B, T] as the server knows it by now.

    Steps after an end that the server learnt of late count too: until it does, a UAV must not undo it.
    """
    if memory is None:
        return batch
    memory.extend(batch)
    storage = cast(BackupdateStorage, memory.storage)
    return storage[storage.latest(batch.shape[1])].transpose(0, 1)


def update(
    batch: TensorDictBase,
    loss: MAPPOLoss,
    optimizer: torch.optim.Optimizer,
    buffer: TensorDictReplayBuffer,
    algo: MappoConfig,
) -> dict[str, float]:
    """One MAPPO update on a batch [B, T]; returns the mean losses."""
    add_advantages(batch, loss, algo)
    buffer.empty()
    buffer.extend(batch.reshape(-1))
    sums: dict[str, float] = {}
    for _ in range(algo.epochs):
        for part in buffer:
            losses = losses_of(part, loss)
            optimizer.zero_grad()
            torch.stack([*losses.values()]).sum().backward()
            torch.nn.utils.clip_grad_norm_(loss.parameters(), algo.max_grad_norm)
            optimizer.step()
            for term, value in losses.items():
                sums[term] = sums.get(term, 0.0) + value.item()
    return {term: total / (algo.epochs * algo.minibatches) for term, total in sums.items()}


def train(config: TrainConfig, folder: Path) -> None:
    """Learn, then evaluate and fill the run folder."""
    env = learning_env(config, config.worlds, config.seed)
    unseen = learning_env(config, config.eval_episodes, config.seed + 10_000)
    actor, critic = make_actor(env, config.model), make_critic(env, config.model)
    loss = mappo_loss(actor, critic, config.algo)
    optimizer = torch.optim.Adam(loss.parameters(), lr=config.algo.lr)
    frames = config.worlds * config.update_steps
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(frames, device=config.device),
        sampler=SamplerWithoutReplacement(),
        batch_size=frames // config.algo.minibatches,
    )
    memory = make_memory(config, env)
    progress, episodes = Progress(), EpisodeLog()
    checkpoint = Checkpoint(
        actor=actor,
        critic=critic,
        optimizer=optimizer,
        progress=progress,
        episodes=episodes,
        rng=GlobalRNGState(),
    )
    if config.resume:
        load(checkpoint, folder)
        env.set_seed(config.seed + progress.updates)  # not the first episodes once more
    save_config(config, folder)
    log = MetricsLog(folder, config.logger.tensorboard, config.logger.csv, progress.frames)
    collector = Collector(
        env, actor, frames_per_batch=frames, total_frames=-1, auto_register_policy_transforms=True
    )
    bar = tqdm(total=config.frames, initial=progress.frames, unit=" steps", unit_scale=True)
    with closing(log), closing(bar), Interrupt() as interrupt:
        for batch in collector if not enough(config, progress, episodes) else ():
            episodes.add(batch)
            losses = update(known_now(memory, batch), loss, optimizer, buffer, config.algo)
            progress.frames += batch.numel()
            progress.updates += 1
            log.add(progress.frames, {**episodes.means(), **mean_terms(batch), **losses})
            bar.set_postfix({name: f"{mean:.2f}" for name, mean in episodes.means().items()})
            bar.update(batch.numel())
            over = enough(config, progress, episodes) or interrupt.asked
            if over or progress.updates % config.checkpoint_every == 0:
                checkpoint.save(folder / CHECKPOINT)
            if over:
                break
    collector.shutdown()
    if interrupt.asked:
        sys.exit(f"interrupted; go on with resume={folder}")
    report(config, folder, unseen, actor, log)


def enough(config: TrainConfig, progress: Progress, episodes: EpisodeLog) -> bool:
    """Has the run lasted as long as it should?"""
    return progress.frames >= config.frames or episodes.finished >= (config.episodes or torch.inf)


def mean_terms(batch: TensorDictBase) -> dict[str, float]:
    """Mean of each weighted reward term, over steps, worlds and UAVs."""
    terms = cast(TensorDictBase, batch["next", "agents", "reward_terms"])
    return {f"reward/{name}": term.mean().item() for name, term in terms.items()}


def report(
    config: TrainConfig, folder: Path, unseen: DelayedEnv, actor: torch.nn.Module, log: MetricsLog
) -> None:
    """Evaluate on situations that were not trained on, and write figure and table."""

    def fly(policy: torch.nn.Module, sample: bool = True) -> Evaluation:
        unseen.set_seed(config.seed + 10_000)  # the same episodes for every policy
        return evaluate(unseen, policy, config.horizon, sample)

    random = fly(random_policy(unseen))
    rows = {"trained, sampled": fly(actor), "trained, mode": fly(actor, False), "random": random}
    table = results_table(rows, config.episode.success_share is not None)
    (folder / "result.md").write_text(table + "\n")
    plot_learning_curve(log.rows, random, folder / FIGURE, f"{config.agents} UAVs, MAPPO")
    print(f"\n{table}\n\nlearning curve: {folder / FIGURE}")


@hydra.main(version_base=None, config_path=CONF, config_name="train")
@reported
def main(written: DictConfig) -> None:
    config, folder = prepare(written)
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    train(config, folder)


if __name__ == "__main__":
    launch(main)
