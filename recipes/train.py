"""Train UAVs with MAPPO or SAC, then evaluate the policy beside a random and a scripted one (docs/runs.md).

damian train scenario=paper/usecase2 delay=paper aware=both hydra.run.dir=runs/first
damian train resume=runs/first frames=600000
"""

__package__ = "damian.recipes"  # also of a script: python recipes/train.py

import shlex
import time
from contextlib import closing
from pathlib import Path
from typing import cast

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tqdm import tqdm

from damian import keys
from damian.common import checks
from damian.common.errors import RunError
from damian.common.fields import leaves
from damian.envs.delayed_env import DelayedEnv
from damian.keys import next_key
from damian.learners.base import Learner, divergence
from damian.learners.schedule import SystemClock
from damian.runs.interrupt import Interrupt, end_interrupted
from damian.runs.loggers import make_loggers
from damian.runs.metrics import Evaluation, evaluate
from damian.runs.metrics_log import MetricsLog
from damian.runs.run_folder import CHECKPOINT, DETERMINISTIC, FIGURE, TRAINED, plot_learning_curve
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
    own_code,
    read_by,
    replay_buffer,
    ticks,
)
from .shared.runs import names_own_code, run_folder, save_config, start, stored_values
from .shared.settings import (
    check_learning,
)


def train(config: TrainConfig, folder: Path) -> None:
    """Train, evaluate, and fill the run folder."""
    check_learning(config)
    env, clock = learning_env(config), SystemClock(config.clock, config.update_steps)
    buffer = replay_buffer(config, env)
    learner = make_learner(config, env, buffer)  # its actor, its critics and their losses
    collector = make_collector(env, learner.actor, config.worlds * clock.unit, config.compiles)
    hindsight = hindsight_returns(config, env)
    state = TrainingState(folder, learner.components(), collector, clock, buffer, hindsight)
    begin(config, state)
    if config.compiles:
        print("compiling: the first update takes up to a minute longer")
    loggers, settings = make_loggers(config.logger, folder), dict(leaves(config))
    log = MetricsLog(
        folder, config.logger.tensorboard, config.logger.csv, state.progress.frames, loggers, settings
    )
    eval_env = make_eval_env(config) if config.eval_every else None
    with closing(log):
        with closing(progress_bar(config, state)) as bar, Interrupt() as interrupt:
            began = time.perf_counter()
            for batch in ticks(collector, clock, env.server) if not enough(config, state) else ():
                update(config, env, learner, state, log, batch)
                frames = state.progress.frames
                log.show(frames, {"steps_per_second": batch.numel() / (time.perf_counter() - began)})
                if eval_env and state.progress.updates % cast(int, config.eval_every) == 0:
                    log.show(frames, evaluate_meanwhile(config, eval_env, learner).row("eval/"))
                began = time.perf_counter()
                show(bar, config, state)
                if save_or_stop(config, state, log, interrupt):
                    break
        if interrupt.asked:
            end_interrupted(interrupt.asked, f"continue with resume={folder}")
        evaluations = report(config, folder, eval_env or make_eval_env(config), learner.actor)
        log.show(state.progress.frames, evaluations[TRAINED].row("eval/"))
        log.show(state.progress.frames, evaluations[TRAINED + DETERMINISTIC].row("eval_deterministic/"))
    module, _, name = config.learner.name.partition(":")
    title = f"{config.agents} UAVs, {name or module.upper()}"
    plot_learning_curve(log.rows, evaluations, folder / FIGURE, title)
    print(f"learning curve: {folder / FIGURE}")
    print(f"fly this policy: {best_flight(evaluations, folder)}{' trust=true' * names_own_code(config)}")


def evaluate_meanwhile(config: TrainConfig, env: DelayedEnv, learner: Learner) -> Evaluation:
    """Evaluate the policy during its training, which afterwards draws the same as without."""
    kept = RandomState().state_dict()
    env.set_seed(config.eval_seed)
    found = evaluate(env, learner.actor, config.horizon)
    RandomState().load_state_dict(kept)
    return found


def best_flight(evaluations: dict[str, Evaluation], folder: Path) -> str:
    """The command that flies the trained policy, drawing its actions or not, whichever is better."""
    policies = {"sampled": TRAINED, "deterministic": TRAINED + DETERMINISTIC}
    scores = {name: evaluations[policy] for name, policy in policies.items()}
    best = max(scores, key=lambda name: (scores[name].success_rate, scores[name].return_))
    return f"damian fly checkpoint={shlex.quote(str(folder))} policy={best}"


def begin(config: TrainConfig, state: TrainingState) -> None:
    """Load what the run continues or starts from, and write the first checkpoint and then the settings."""
    if config.resume:
        state.load()
        made = state.progress
        should = f"is fewer than the {made.frames} that the run has made"
        checks.require(
            made.frames - made.frames / max(made.updates, 1) < config.frames, "frames", config.frames, should
        )
    elif config.checkpoint:
        trained = stored_values(run_folder(Path(config.checkpoint)), "checkpoint")["learner"]["name"]
        names = ["actor", "critic"] if trained == config.learner.name else ["actor"]
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
    progress, episodes = state.progress, state.episodes
    episodes.add(batch)
    progress.frames += batch.numel()
    progress.updates += 1
    if problem := not_finite(env.server, env.uav_env.simulation, batch):
        raise failure(state, problem)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(config.threads)
        with own_code(config.learner.name):
            losses = {name: float(number) for name, number in learner.learn(read_by(config, batch)).items()}
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
    """A progress bar that counts episodes if ``config.episodes`` limits the run, else environment steps."""
    if config.episodes:
        return tqdm(total=config.episodes, initial=state.episodes.finished, unit=" episodes")
    return tqdm(total=config.frames, initial=state.progress.frames, unit=" steps", unit_scale=True)


def show(bar: tqdm, config: TrainConfig, state: TrainingState) -> None:
    """Show how far the training has come."""
    bar.set_postfix({name: f"{mean:.2f}" for name, mean in state.episodes.means().items()})
    bar.update((state.episodes.finished if config.episodes else state.progress.frames) - bar.n)


def enough(config: TrainConfig, state: TrainingState) -> bool:
    """Has the run reached ``config.frames`` or ``config.episodes``?"""
    return state.progress.frames >= config.frames or state.episodes.finished >= (config.episodes or torch.inf)


def save_or_stop(config: TrainConfig, state: TrainingState, log: MetricsLog, interrupt: Interrupt) -> bool:
    """Write a checkpoint after an update if one is due; returns whether the training ends here."""
    finished, asked = enough(config, state), interrupt.asked is not None
    due = state.progress.updates % config.checkpoint_every == 0
    if due or finished or asked:
        log.sync()
        if due or finished:
            state.save_best(due)
        state.save()
    return finished or asked


@cli.one_line_errors("train")
@hydra.main(config_path="../conf", config_name="train", version_base=None)
def main(given: DictConfig) -> None:
    start(train, given, "train")


if __name__ == "__main__":
    main()
