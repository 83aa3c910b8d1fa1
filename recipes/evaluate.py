"""Evaluate a trained policy: as it was trained, or with more UAVs, other delays or another region.

damian evaluate checkpoint=runs/first agents=10 delay=paper
damian evaluate -m checkpoint=runs/first,runs/second delay.obs=0,2,4,8

Words change settings of the run; what is not mentioned stays.
"""

import statistics
from pathlib import Path
from typing import NamedTuple, cast

import torch
from omegaconf import DictConfig
from tensordict.nn import InteractionType, TensorDictModuleBase
from torchrl.modules import ProbabilisticActor

from damian.baselines.planner import Planner, planner_policy
from damian.baselines.random import random_policy
from damian.baselines.script import script_policy
from damian.common.errors import InputError
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.models.memory import add_recurrent_state
from damian.runs.metrics import Evaluation, evaluate
from damian.runs.run_folder import (
    DETERMINISTIC,
    PLANNER,
    RANDOM,
    SCRIPT,
    TRAINED,
    UNTRAINED,
    save_results,
)
from damian.runs.training_state import load_networks

from . import cli
from .config import EvaluateConfig, PlannerConfig, TrainConfig
from .shared.learning import assume, own_code
from .shared.runs import run_settings, save_config, start

MEANING = """untrained: the same network before any training; its results are not learnt. script: a rule
of thumb on the same observations. Actions are drawn from the policy's distribution; deterministic: the most
likely one is taken. A policy without memory often needs chance to search."""
"""Lines under the table of an evaluation."""


def fly(config: TrainConfig, folder: Path) -> None:
    """Evaluate the policy of ``config.checkpoint``, or the untrained networks, and fill the run
    folder."""
    env = make_eval_env(config)
    actor = stored_actor(config, env) if config.checkpoint else None
    save_config(config, folder)
    planner = None
    if isinstance(config, EvaluateConfig) and config.policy == PLANNER:
        planner = config.planner
    report(config, folder, env, actor, planner)


def fly_script(config: TrainConfig, folder: Path) -> None:
    """Evaluate the script, without any network."""
    save_config(config, folder)
    report(config, folder, make_eval_env(config), networks=False)


def fly_planner(config: TrainConfig, folder: Path) -> None:
    """Evaluate the planner with its default settings, without any network."""
    save_config(config, folder)
    report(config, folder, make_eval_env(config), planner=PlannerConfig(), networks=False)


def stored_actor(config: TrainConfig, env: DelayedEnv) -> ProbabilisticActor:
    """The actor of ``config.checkpoint``, for an environment."""
    actor = config.learner.make_actor(env, config.model)
    load_networks(Path(str(config.checkpoint)), "checkpoint", {"actor": actor})
    return actor


class Loaded(NamedTuple):
    """A trained policy, and an environment in which it can fly."""

    policy: ProbabilisticActor
    env: DelayedEnv


def load(
    run: str | Path,
    *overrides: str,
    num_worlds: int = 1,
    seed: int | None = None,
    deterministic: bool = False,
    trust: bool = False,
) -> Loaded:
    """Load the trained policy of a run folder, with an environment of its scenario or of a changed
    one.

    Args:
        run: run folder, the ``best.pt`` in it, or ``damian:NAME``, one of the package
            (docs/policies.md).
        *overrides: changes to the settings of the run, such as ``delay.obs=6`` or ``agents=5``.
        num_worlds: number of parallel environments, B.
        seed: of the environment; that of ``damian evaluate`` if not given.
        deterministic: take the most likely actions; if not, they are drawn from the policy's
            distribution.
        trust: import the components ``package.module:Name`` that the run names, which runs their
            code.

    Returns:
        The policy, without gradients, and the environment, [B].

    Raises:
        InputError: there is no run, or its policy does not fit the changed settings.

    Examples:
        >>> policy, env = damian.load("runs/first", "delay.obs=6", num_worlds=64, deterministic=True)
        >>> rollout = env.rollout(50, policy, break_when_any_done=False)
    """
    words = [f"checkpoint='{run}'", *overrides, *["trust=true"] * trust]
    with run_settings(cli.composed(*words), words) as config:
        eval_seed = config.eval_seed if seed is None else seed
        env = make_env(config, num_worlds, eval_seed, config.device, ["message"])
        policy = stored_actor(config, env).eval().requires_grad_(False)
        assume(config, env, policy)
    add_recurrent_state(env, policy)
    kind = InteractionType.DETERMINISTIC if deterministic else InteractionType.RANDOM
    setattr(policy[-1], "default_interaction_type", kind)  # noqa: B010 (a module declares no such attribute)
    return Loaded(policy, env)


def make_eval_env(config: TrainConfig) -> DelayedEnv:
    """The environment of an evaluation, a world for each episode; its initial conditions are
    new."""
    return make_env(config, config.eval_episodes, config.eval_seed, config.device, ["message"])


def report(
    config: TrainConfig,
    folder: Path,
    env: DelayedEnv,
    actor: TensorDictModuleBase | None = None,
    planner: PlannerConfig | None = None,
    *,
    networks: bool = True,
) -> dict[str, Evaluation]:
    """Evaluate an actor beside others, write, print and return the results, by policy."""

    def fly(policy: TensorDictModuleBase, sample: bool = True, learnt: bool = False) -> Evaluation:
        env.set_seed(config.eval_seed)  # the same episodes for every policy
        assume(config, env, policy if learnt else None)
        return evaluate(env, policy, config.horizon, sample, config.metrics)

    random = fly(random_policy(env))
    rows = {}
    untrained = untrained_actor(config, env) if networks else None
    for name, policy in {TRAINED: actor, UNTRAINED: untrained}.items():
        if policy is not None:
            sampled = fly(policy, learnt=True)
            most_likely = fly(policy, sample=False, learnt=True)
            rows = {name: sampled, name + DETERMINISTIC: most_likely} | rows
    try:
        rows[SCRIPT] = fly(script_policy(env))
    except InputError as error:  # the region is too large for the script, but not for the networks
        print(f"no {SCRIPT}: {error}")
    rows[RANDOM] = random
    if planner is not None:
        compile = config.compile is True
        policy = planner_policy(env, planner.horizon, planner.samples, compile=compile)
        rows[PLANNER] = fly(policy)
        spent = cast(Planner, policy.module).milliseconds
        print(f"planner: {statistics.median(spent):.0f} ms for a decision in all worlds at once")
    table = save_results(rows, folder, config.episode.can_succeed, env.delays.obs.late, MEANING)
    print(f"\nmeans of {config.eval_episodes} episodes:\n\n{table}\n")
    return rows


def untrained_actor(config: TrainConfig, env: DelayedEnv) -> ProbabilisticActor:
    """The actor, with its prior, as a training of the same seed begins with it."""
    with torch.random.fork_rng(devices=[]), own_code(config.learner):
        torch.manual_seed(config.seed)
        return config.learner.make_actor(env, config.model)


@cli.program("evaluate")
def main(given: DictConfig) -> None:
    start(fly, given, "evaluate")
