"""Train UAVs with MAPPO or SAC, then evaluate the policy beside a random and a greedy (scripted) one.

    damian train agents=3 scenario=spotting motion=polynomial seed=1
    damian train scenario=paper/usecase2 delay=paper aware=both
    damian train learner=sac scenario=tracking actions=continuous
    damian train -m seed=0,1,2 agents=3,5
    damian train hydra.run.dir=runs/first
    damian train resume=runs/first frames=600000

``--help`` lists the groups of settings, ``--help KEY`` explains a setting or a section. The run folder,
runs/DATE_TIME unless hydra.run.dir names another one, gets config.yaml, run.json (versions, machine, wall
time), metrics.csv (a row for each update), TensorBoard events, checkpoint, learning_curve.png, and the
evaluation as result.csv and result.md.
"""

import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.checkpoint import Checkpoint, GlobalRNGState
from torchrl.collectors import Collector
from torchrl.data import ReplayBuffer
from torchrl.envs import RewardSum, StepCounter, TransformedEnv
from tqdm import tqdm

from damian import keys
from damian.baselines.greedy import greedy_policy
from damian.baselines.random import random_policy
from damian.common import checks
from damian.common.errors import naming_errors
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import has_message_delay, make_env
from damian.evaluation.comparison import GREEDY, MODE, RANDOM, SAMPLED
from damian.evaluation.loggers import make_loggers
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
from damian.keys import next_key
from damian.learners.base import Learner, check_learner, check_numbers
from damian.learners.recurrent import add_recurrent_state
from damian.learners.schedule import SystemClock
from damian.replay.backupdate import BackupdateStorage
from damian.replay.corrections import corrections_of
from damian.replay.recompute import server_recompute
from damian.replay.time_storage import TimeStorage
from damian.server.server import Server

from .shared.known_settings import CONF
from .shared.launch import launch, load, perform, prepare, reported, save_config, stored_config
from .shared.settings import TrainConfig

MEANING = """sampled: actions are drawn from the policy's distribution; mode: the most likely action is taken.
Fly the one with the higher return: a policy without memory often needs chance to search."""
"""Lines under the table of an evaluation."""


@dataclass
class Progress:
    """How far the training of a run has come; part of its checkpoint."""

    frames: int = 0
    """Environment steps, over all worlds."""
    updates: int = 0
    """Batches that the learner has learnt from."""

    def state_dict(self) -> dict[str, int]:
        return {"frames": self.frames, "updates": self.updates}

    def load_state_dict(self, state: dict[str, int]) -> None:
        self.frames, self.updates = int(state["frames"]), int(state["updates"])


def learning_env(config: TrainConfig) -> DelayedEnv:
    """The environment of the training, [B], with what the learner and the logs need."""
    messages = config.backupdates or config.clock.trigger is not None
    privileged = config.critic == "privileged"
    reads = set(config.learner.reads) - {"hindsight"}  # the storage adds it
    extras = {"reward_terms", *["message"] * messages, *["privileged"] * privileged, *reads}
    env = make_env(config.train_scenario, config.worlds, config.seed, config.device, extras)
    if config.compile:
        env.compile()
    env.append_transform(RewardSum(in_keys=[keys.REWARD], out_keys=[keys.EPISODE_REWARD]))
    env.append_transform(StepCounter())
    return env


def make_learner(config: TrainConfig, env: DelayedEnv) -> Learner:
    """The learner, with a replay buffer (back-updating or not) if it needs one."""
    setup, name = config.learning_setup, config.learner.name
    with own_code(name):
        size = config.learner.buffer_size(setup)
    buffer = None if size is None else make_buffer(config, env, size)
    with own_code(name):
        learner = config.learner.make(env, setup, buffer)
        check_learner(learner, name)
    return learner


def own_code(learner: str) -> AbstractContextManager[None]:
    """A context that names a learner of the user's own in errors; a built-in one keeps its traceback."""
    return naming_errors(learner) if ":" in learner else nullcontext()


def make_buffer(config: TrainConfig, env: DelayedEnv, size: int) -> ReplayBuffer:
    """A replay buffer of ``size`` environment steps; with ``backupdate``, what arrives late corrects them."""
    if not config.backupdates:
        return ReplayBuffer(storage=TimeStorage(size, device=config.device))
    setup, actor = config.learning_setup, config.recompute_actor
    least = (setup.longest_period + 2 * setup.longest_delay) * setup.worlds
    should = f"is too little for back-updating, which needs {least}: a period and twice the longest delay"
    checks.require(size >= least, f"{config.learner.name}: buffer_size", size, should)
    recompute = server_recompute(env.server, actor=actor) if has_message_delay(config) else None
    observed = [keys.GLOBAL_OBSERVATION, *[keys.OBSERVATION] * actor] if recompute else []
    corrections = corrections_of(env.transform, [keys.REWARD, *observed])
    size += sum(correction.lookback for correction in corrections) * setup.worlds
    storage = BackupdateStorage(
        size,
        recompute,
        config.longest_wait,
        corrections=corrections,
        hindsight_key=keys.HINDSIGHT if "hindsight" in config.learner.reads else None,
        device=config.device,
    )
    return ReplayBuffer(storage=storage)


def make_collector(env: TransformedEnv, actor: torch.nn.Module, frames: int) -> Collector:
    """An endless collector of batches of ``frames`` environment steps."""
    add_recurrent_state(env, actor)
    return Collector(
        env, actor, frames_per_batch=frames, total_frames=-1, auto_register_policy_transforms=True
    )


def ticks(collector: Collector, clock: SystemClock) -> Iterator[TensorDictBase]:
    """Batches [B, T], each collected between two ticks of the system clock (paper, section 3.6)."""
    parts: list[TensorDictBase] = []
    for part in collector:
        parts.append(part)
        if sum(part.shape[1] for part in parts) < clock.period:
            continue
        batch = cast(TensorDictBase, torch.cat(parts, 1)) if len(parts) > 1 else part  # type: ignore[arg-type]
        if clock.change:
            clock.tick(spotting(batch, cast(DelayedEnv, collector.env).server))
        parts = []
        yield batch


def spotting(batch: TensorDictBase, server: Server) -> torch.Tensor:
    """Which UAVs spot the source at the end of a batch [B, T], by what the server holds, [B, N] bool."""
    after = cast(TensorDictBase, batch["next"][:, -1])
    return server.messages(after.get(keys.RECEIVED, after[keys.MESSAGE])).spotted


def train(config: TrainConfig, folder: Path) -> None:
    """Train, evaluate, and fill the run folder.

    Raises:
        InputError: the settings do not allow training, or the checkpoint cannot be loaded.
    """
    config.check_learning()
    env, clock = learning_env(config), SystemClock(config.clock, config.update_steps)
    learner = make_learner(config, env)
    progress, episodes = Progress(), EpisodeLog()
    state = {"progress": progress, "episodes": episodes, "clock": clock, "rng": GlobalRNGState()}
    checkpoint = Checkpoint(**learner.components(), **state)
    if config.resume:
        load(checkpoint, folder, "resume")
        env.set_seed(config.seed + 1_000_003 * progress.updates)  # do not repeat the first episodes
    elif config.checkpoint:
        load(checkpoint, Path(config.checkpoint), "checkpoint", ["actor", *["critic"] * same_learner(config)])
    save_config(config, folder)
    loggers = make_loggers(config.logger.custom, folder)
    log = MetricsLog(folder, config.logger.tensorboard, config.logger.csv, progress.frames, loggers)
    collector = make_collector(env, learner.actor, config.worlds * clock.unit)
    bar = progress_bar(config, progress, episodes)
    with closing(log), closing(bar), Interrupt() as interrupt:
        for batch in ticks(collector, clock) if not enough(config, progress, episodes) else ():
            episodes.add(batch)
            with own_code(config.learner.name):
                losses = check_numbers(learner.learn(batch), config.learner.name)
            progress.frames += batch.numel()
            progress.updates += 1
            means = {"episodes": float(episodes.finished), **episodes.means()}
            log.add(progress.frames, {**means, **mean_terms(batch), **losses})
            bar.set_postfix({name: f"{mean:.2f}" for name, mean in episodes.means().items()})
            bar.update((episodes.finished if config.episodes else progress.frames) - bar.n)
            last = enough(config, progress, episodes) or interrupt.asked
            if last or progress.updates % config.checkpoint_every == 0:
                checkpoint.save(folder / CHECKPOINT)
            if last:
                break
    collector.shutdown()
    if interrupt.asked:
        sys.exit(f"interrupted; continue with resume={folder}")
    random = report(config, folder, make_eval_env(config), learner.actor)
    plot_learning_curve(log.rows, random, folder / FIGURE, f"{config.agents} UAVs, {learner_title(config)}")
    print(f"learning curve: {folder / FIGURE}")


def learner_title(config: TrainConfig) -> str:
    """Name of the learner for titles: MAPPO, SAC, or the class of one's own."""
    module, _, name = config.learner.name.partition(":")
    return name or module.upper()


def same_learner(config: TrainConfig) -> bool:
    """Was ``config.checkpoint`` trained by the same learner, so that its critic can be loaded too?"""
    folder = Path(str(config.checkpoint))
    if not (folder / CONFIG).is_file():
        return True
    return stored_config(folder, "checkpoint").learner.name == config.learner.name


def progress_bar(config: TrainConfig, progress: Progress, episodes: EpisodeLog) -> tqdm:
    """A progress bar that counts episodes if ``config.episodes`` limits the run, else environment steps."""
    if config.episodes:
        return tqdm(total=config.episodes, initial=episodes.finished, unit=" episodes")
    return tqdm(total=config.frames, initial=progress.frames, unit=" steps", unit_scale=True)


def enough(config: TrainConfig, progress: Progress, episodes: EpisodeLog) -> bool:
    """Has the run reached ``config.frames`` or ``config.episodes``?"""
    return progress.frames >= config.frames or episodes.finished >= (config.episodes or torch.inf)


def mean_terms(batch: TensorDictBase) -> dict[str, float]:
    """Mean of each weighted reward term (eq. 5-8) over the steps, worlds and UAVs of a batch [B, T]."""
    terms = cast(TensorDictBase, batch[next_key(keys.REWARD_TERMS)])
    return {f"reward/{name}": term.mean().item() for name, term in terms.items()}


def make_eval_env(config: TrainConfig) -> DelayedEnv:
    """The environment of an evaluation, a world for each episode; its initial conditions are new."""
    return make_env(config.eval_scenario, config.eval_episodes, config.eval_seed, config.device, ["message"])


def report(config: TrainConfig, folder: Path, env: DelayedEnv, actor: torch.nn.Module) -> Evaluation:
    """Evaluate an actor, write the results into the run folder and print them.

    Returns:
        The evaluation of the random policy in the same episodes.
    """

    def fly(policy: torch.nn.Module, sample: bool = True) -> Evaluation:
        env.set_seed(config.eval_seed)  # the same episodes for every policy
        return evaluate(env, policy, config.horizon, sample)

    random = fly(random_policy(env))
    rows = {SAMPLED: fly(actor), MODE: fly(actor, False), RANDOM: random, GREEDY: fly(greedy_policy(env))}
    can_succeed, late = config.episode.success_share is not None, has_message_delay(config)
    table = save_results(rows, folder, can_succeed, late, MEANING)
    print(f"\n{table}\n")
    return random


@hydra.main(version_base=None, config_path=CONF, config_name="train")
@reported
def main(composed: DictConfig) -> None:
    perform(*prepare(composed), train)


def run() -> None:
    """Run the program with the words of the command line."""
    launch(main)


if __name__ == "__main__":
    run()
