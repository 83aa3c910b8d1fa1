"""Which late messages cost how much: the script flies with ever more known on time.

    python examples/studies/on_time.py scenario=delaybench/tracking delay.obs=4 eval_episodes=500

With all messages on time the script is a strong reference, and no proven limit: a policy that plans further
ahead may win more. The words are those of ``damian train``.
"""

import sys
from dataclasses import replace
from typing import cast

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torch.nn.functional import one_hot

from damian import keys
from damian.baselines.script import script_policy
from damian.common import checks
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.recipes.cli import settings
from damian.recipes.config import TrainConfig
from damian.runs.metrics import Evaluation, evaluate
from damian.runs.run_folder import results_table
from damian.server.belief import SourceGrid, places
from damian.world.state import Truth

KNOWN_ON_TIME = ("what has arrived", "its own messages", "all messages", "the source's place")
"""What the script knows on time in each row of the results."""


def script_rows(config: TrainConfig) -> dict[str, Evaluation]:
    """Evaluations of the script, in the same episodes, by what is known on time."""
    checks.require(config.delays.obs.late, "delay.obs", config.delay.obs, "leaves no message late or lost")
    should = "is nothing that the script seeks: it finds sources, of which the server knows"
    checks.require(
        config.seeks_source and config.links.kind == "server", "scenario", config.links.kind, should
    )
    features = config.observation.belief or ["belief_moments"]
    late, own = (
        replace(config, observation=replace(config.observation, own=knows, belief=features))
        for knows in (False, True)
    )
    undelayed = replace(late, delay=replace(config.delay, obs=0, loss=0.0, hold="none"))
    flights, rows = [(late, False), (own, False), (undelayed, False), (undelayed, True)], {}
    for known, (scenario, true_place) in zip(KNOWN_ON_TIME, flights, strict=True):
        env = make_env(scenario, config.eval_episodes, config.eval_seed, config.device, ["message", "state"])
        script: TensorDictModuleBase = script_policy(env)
        if true_place:
            script = TensorDictSequential([true_belief(env), script])  # type: ignore[list-item]
        rows[known] = evaluate(env, script, config.horizon)
    return rows


def true_belief(env: DelayedEnv) -> TensorDictModule:
    """A module that replaces the server's belief by certainty about each source's cell."""
    server = env.server
    grid = cast(SourceGrid, server.grid)

    def know(state: Tensor, message: Tensor) -> Tensor:
        inside = grid.prior[places(grid, server.region_of(server.messages(message)))] > 0
        truth = Truth.unpack(state, env.uav_env.simulation.widths)
        distance = torch.cdist(truth.source.to(grid.centres), grid.centres)
        return one_hot(distance.where(inside, torch.inf).argmin(-1), distance.shape[-1]).to(distance)

    return TensorDictModule(know, in_keys=[keys.STATE, keys.MESSAGE], out_keys=[keys.BELIEF])


if __name__ == "__main__":
    config = settings(*sys.argv[1:])
    print(results_table(script_rows(config), config.episode.can_succeed, late=True))
