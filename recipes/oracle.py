"""Fly the script with ever more known on time: which late messages cost how much (docs/protocol.md).

With all messages on time the script is a strong reference, and no proven limit: a policy that plans further
ahead may win more.
"""

from dataclasses import replace
from pathlib import Path
from typing import cast

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torch.nn.functional import one_hot

from damian import keys
from damian.baselines.greedy import greedy_policy
from damian.common import checks
from damian.common.errors import InputError
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import has_message_delay, make_env
from damian.runs.metrics import Evaluation, evaluate
from damian.runs.run_folder import save_results
from damian.server.belief import SourceGrid

from . import cli
from .config import TrainConfig
from .shared.runs import save_config

KNOWN_ON_TIME = ("what has arrived", "its own messages", "all messages", "the source's place")
"""What the script knows on time in each row of the results."""


def fly(config: TrainConfig, folder: Path) -> None:
    """Evaluate the script by what is known on time, and fill the run folder."""
    check(config)
    save_config(config, folder)
    table = save_results(script_rows(config), folder, config.episode.success_share is not None, late=True)
    print(f"\nwhat is known on time:\n\n{table}")


def check(config: TrainConfig) -> None:
    """Check that the rows can differ, and that they follow from what the server broadcasts."""
    if config.checkpoint:
        remedy = "a policy flies with more on time by damian evaluate with observation.own=true or delay=none"
        raise InputError(f"checkpoint: the script flies here; {remedy}")
    if not has_message_delay(config):
        raise InputError("delay.obs: no message is late or lost; choose a delay such as delay=paper")
    should = "is not supported: the rows compare what the server can know; choose links=server"
    checks.require(config.links.kind == "server", "links", config.links.kind, should)
    if not config.seeks_source:
        raise InputError("reward: nothing is won by finding the source, which is all that the script does")


def script_rows(config: TrainConfig) -> dict[str, Evaluation]:
    """Evaluations of the script, in the same episodes, by what is known on time."""
    features = config.observation.belief or ["belief_moments"]
    late, own = (
        replace(config.eval_scenario, observation=replace(config.observation, own=knows, belief=features))
        for knows in (False, True)
    )
    undelayed = replace(late, delay=replace(config.delay, obs=0, loss=0.0, hold="none"))
    flights, rows = [(late, False), (own, False), (undelayed, False), (undelayed, True)], {}
    for known, (scenario, true_place) in zip(KNOWN_ON_TIME, flights, strict=True):
        env = make_env(scenario, config.eval_episodes, config.eval_seed, config.device, ["message", "state"])
        script: TensorDictModuleBase = greedy_policy(env)
        if true_place:
            script = TensorDictSequential([true_belief(env), script])  # type: ignore[list-item]
        rows[known] = evaluate(env, script, config.horizon)
    return rows


def true_belief(env: DelayedEnv) -> TensorDictModule:
    """A module that replaces the server's belief by certainty about the source's cell."""
    server = env.server
    grid = cast(SourceGrid, server.grid)

    def know(state: Tensor, message: Tensor) -> Tensor:
        inside = grid.prior[server.region_of(server.messages(message))] > 0
        distance = torch.cdist(state[..., -2:].to(grid.centres), grid.centres)
        return one_hot(distance.where(inside, torch.inf).argmin(-1), distance.shape[-1]).to(distance)

    return TensorDictModule(know, in_keys=[keys.STATE, keys.MESSAGE], out_keys=[keys.BELIEF])


def run() -> None:
    cli.run(fly)
