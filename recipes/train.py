"""Train UAVs with MAPPO or SAC, then evaluate the policy beside a random and a scripted one
(docs/runs.md).

damian train scenario=paper/usecase2 delay=paper aware=backupdate+history hydra.run.dir=runs/first
damian train agents=3 seed=0 frames=300000 worlds=64 device=cuda compile=true learner.lr=3e-4
damian train delay.obs=3  (steps; or 3s, 1..7 (uniform), 3s..7s, "{law: geometric, mean: 2s}"; delay.act)
damian train resume=runs/first frames=600000     (the run goes on)
damian train checkpoint=runs/first delay=paper   (a new run that begins with its policy)
damian train -m seed=0,1,2 delay=none,paper      (a sweep; the same command goes on with what is missing)

--config-dir FOLDER has options of your own.
"""

__package__ = "damian.recipes"  # also of a script: python recipes/train.py

import shlex
import time
from contextlib import closing
from pathlib import Path
from typing import cast

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tqdm import tqdm

from damian import keys
from damian.common import checks
from damian.common.errors import RunError
from damian.common.fields import leaves
from damian.compare.figures import plot_training
from damian.envs.delayed_env import DelayedEnv
from damian.keys import next_key
from damian.learners.base import Learner, divergence
from damian.learners.schedule import SystemClock
from damian.runs.metrics import Evaluation, evaluate
from damian.runs.metrics_log import MetricsLog, make_loggers
from damian.runs.processes import Interrupt, end_interrupted
from damian.runs.run_folder import CHECKPOINT, DETERMINISTIC, TRAINED
from damian.runs.training_state import RandomState, TrainingState, load_networks
from damian.server.components import not_finite

from . import cli
from .config import TrainConfig
from .evaluate import make_eval_env, report
from .shared.learning import (
    hindsight_returns,
    learning_env,
    make_collector,
    make_learner,
    map_summary,
    own_code,
    read_by,
    replay_buffer,
    require_delayed_talk,
    ticks,
)
from .shared.runs import run_folder, save_config, start, stored_values
from .shared.settings import check_learning

FIGURE = "learning_curve.png"


def train(config: TrainConfig, folder: Path) -> None:
    """Train, evaluate, and fill the run folder."""
    check_learning(config)
    env = learning_env(config)
    clock = SystemClock(config.clock, config.update_steps)
    buffer = replay_buffer(config, env)
    learner = make_learner(config, env, buffer)  # its actor, its critics and their losses
    collector = make_collector(env, learner.actor, config.worlds * clock.unit, config.compiles)
    require_delayed_talk(config, cast(DelayedEnv, collector.env), learner)
    hindsight = hindsight_returns(config, env)
    state = TrainingState(folder, learner.components(), collector, clock, buffer, hindsight)
    begin(config, state)
    if config.region.kind == "geojson":  # what was read of a map
        print(map_summary(env.uav_env.simulation), flush=True)
    if config.compiles:
        print("compiling: the first update takes up to a minute longer")
    made = state.progress.frames
    loggers = make_loggers(config.logger, folder, made)
    log = MetricsLog(folder, config.logger.csv, made, loggers, dict(leaves(config)))
    eval_env = make_eval_env(config) if config.eval_every else None
    with closing(log):
        with closing(progress_bar(config, state)) as bar, Interrupt() as interrupt:
            began = time.perf_counter()
            for batch in ticks(collector, clock, env.server) if not enough(config, state) else ():
                update(config, env, learner, state, log, batch)
                frames = state.progress.frames
                log.show(
                    frames, {"steps_per_second": batch.numel() / (time.perf_counter() - began)}
                )
                if eval_env and state.progress.updates % cast(int, config.eval_every) == 0:
                    log.show(
                        frames, grouped("eval/", evaluate_meanwhile(config, eval_env, learner))
                    )
                began = time.perf_counter()
                bar.set_postfix(
                    {name: f"{mean:.2f}" for name, mean in state.episodes.means().items()}
                )
                bar.update(counted(config, state) - bar.n)
                if save_or_stop(config, state, log, interrupt):
                    break
        if interrupt.asked:
            end_interrupted(f"continue with resume={folder}", interrupt.asked)
        evaluations = report(config, folder, eval_env or make_eval_env(config), learner.actor)
        log.show(state.progress.frames, grouped("eval/", evaluations[TRAINED]))
        likeliest = evaluations[TRAINED + DETERMINISTIC]
        log.show(state.progress.frames, grouped("eval_deterministic/", likeliest))
    module, _, name = config.learner.name.partition(":")
    title = f"{config.agents} UAVs, {name or module.upper()}"
    plot_training(log.rows, evaluations, folder / FIGURE, title)
    print(f"learning curve: {folder / FIGURE}")
    print(f"fly this policy: damian fly checkpoint={shlex.quote(str(folder))}")


def grouped(group: str, evaluation: Evaluation) -> dict[str, float]:
    """An evaluation with the name of a group before each of its names."""
    return {group + name: number for name, number in evaluation.items()}


def evaluate_meanwhile(config: TrainConfig, env: DelayedEnv, learner: Learner) -> Evaluation:
    """Evaluate the policy during its training, which afterwards draws the same as without."""
    kept = RandomState().state_dict()
    env.set_seed(config.eval_seed)
    found = evaluate(env, learner.actor, config.horizon, metrics=config.metrics)
    RandomState().load_state_dict(kept)
    return found


def begin(config: TrainConfig, state: TrainingState) -> None:
    """Load what the run continues or starts from, and write the first checkpoint and then the
    settings."""
    if config.resume:
        state.load()
        made = state.progress.frames
        updates = max(state.progress.updates, 1)
        checks.require(
            made - made / updates < config.frames,
            "frames",
            config.frames,
            f"is fewer than the {made} that the run has made",
        )
    elif config.checkpoint:
        trained = stored_values(run_folder(Path(config.checkpoint)), "checkpoint")["learner"][
            "name"
        ]
        shipped = config.checkpoint.startswith("damian:")  # without a critic
        names = ["actor", "critic"] if trained == config.learner.name and not shipped else ["actor"]
        networks = {name: state.components[name] for name in names if name in state.components}
        load_networks(Path(config.checkpoint), "checkpoint", networks)
    if not config.resume:
        state.save()
    save_config(config, state.folder)


def update(
    config: TrainConfig,
    env: DelayedEnv,
    learner: Learner,
    state: TrainingState,
    log: MetricsLog,
    batch: TensorDictBase,
) -> None:
    """Make one update from a batch [B, T], and log its numbers."""
    progress = state.progress
    episodes = state.episodes
    episodes.add(batch)
    progress.frames += batch.numel()
    progress.updates += 1
    if problem := not_finite(env.layout, batch):
        raise failure(state, problem)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(config.threads)
        with own_code(config.learner):
            losses = {
                name: float(number)
                for name, number in learner.learn(read_by(config, env.delays, batch)).items()
            }
    except (ValueError, RuntimeError):  # torch's distributions refuse a nan
        check_convergence(config, state, {})
        raise
    finally:
        torch.set_num_threads(threads)
    means = {"episodes": float(episodes.finished), **episodes.means()}
    terms = cast(TensorDictBase, batch[next_key(keys.REWARD_TERMS)])
    rewards = {f"reward/{name}": x.mean().item() for name, x in terms.items()}
    log.add(progress.frames, {**means, **rewards, **losses})
    check_convergence(config, state, losses)


def check_convergence(config: TrainConfig, state: TrainingState, losses: dict[str, float]) -> None:
    """Stop a run whose learner has diverged, before its checkpoint is replaced."""
    if problem := divergence(state.components, losses):
        remedy = f"choose a smaller learner.lr than {config.learner.lr:g}"
        raise failure(state, f"{problem}: the learner has diverged; {remedy}")


def failure(state: TrainingState, problem: str) -> RunError:
    """The error of a run that cannot go on after an update."""
    saved = f"{state.folder / CHECKPOINT} is of update {state.saved} and intact"
    return RunError(f"update {state.progress.updates}: {problem}; {saved}")


def progress_bar(config: TrainConfig, state: TrainingState) -> tqdm:
    """A progress bar that shows how far the training has come."""
    unit, total = (" episodes", config.episodes) if config.episodes else (" steps", config.frames)
    return tqdm(
        total=total, initial=counted(config, state), unit=unit, unit_scale=not config.episodes
    )


def counted(config: TrainConfig, state: TrainingState) -> int:
    """How far the training has come: in episodes if they limit the run, else in environment
    steps."""
    return state.episodes.finished if config.episodes else state.progress.frames


def enough(config: TrainConfig, state: TrainingState) -> bool:
    """Whether the run has reached ``config.frames`` or ``config.episodes``."""
    return state.progress.frames >= config.frames or state.episodes.finished >= (
        config.episodes or torch.inf
    )


def save_or_stop(
    config: TrainConfig, state: TrainingState, log: MetricsLog, interrupt: Interrupt
) -> bool:
    """Write a checkpoint after an update if one is due; returns whether the training ends here."""
    finished = enough(config, state)
    asked = interrupt.asked is not None
    due = state.progress.updates % config.checkpoint_every == 0
    if due or finished or asked:
        log.sync()
        if due or finished:
            state.save_best(due)
        state.save()
    return finished or asked


@cli.program("train")
def main(given: DictConfig) -> None:
    start(train, given, "train")


if __name__ == "__main__":
    main()
