"""Fly the script that reads the belief, with ever more known on time: what a delay leaves to be won.

    damian ceiling scenario=delaybench/tracking delay=paper
    damian ceiling -m scenario=delaybench/tracking delay.obs=2,4,8,16

Nothing is trained. The script (``damian.baselines.greedy.Searcher``) flies each UAV where it most probably
detects the source next, as the belief says. Its returns with ever more known on time are the information
ceiling of a task under a delay; a policy that plans further ahead may win more. The run folder gets
config.yaml, result.csv and result.md, with one row for what is known: the messages that have arrived at the
server (regime R0, docs/protocol.md), with each UAV's own messages at once (R0), all messages at once (R3),
the source's true place (R3).
"""

from dataclasses import replace
from pathlib import Path
from typing import cast

import hydra
import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torch.nn.functional import one_hot

from damian import keys
from damian.baselines.greedy import greedy_policy
from damian.common import checks
from damian.common.errors import InputError
from damian.compare.comparison import CEILING
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import has_message_delay, make_env
from damian.envs.scenario import ScenarioConfig
from damian.runs.metrics import Evaluation, evaluate
from damian.runs.run_folder import save_results
from damian.server.belief import SourceGrid

from .shared.known_settings import CONF
from .shared.launch import launch, perform, prepare, reported
from .shared.settings import TrainConfig
from .shared.stored_runs import save_config


def fly(config: TrainConfig, folder: Path) -> None:
    """Evaluate the script with ever more known on time, and fill the run folder."""
    check(config)
    save_config(config, folder)
    on_time = replace(config.delay, obs=0, loss=0.0, hold="none")
    server, own = (_believing(config, own) for own in (False, True))
    undelayed = replace(server, delay=on_time)
    flights = (server, False), (own, False), (undelayed, False), (undelayed, True)
    rows = {
        known: _script(config, scenario, true_place)
        for known, (scenario, true_place) in zip(CEILING, flights, strict=True)
    }
    table = save_results(rows, folder, config.episode.success_share is not None, late=True)
    print(f"\nwhat is known on time:\n\n{table}")


def check(config: TrainConfig) -> None:
    """Check that the rows of a ceiling can differ.

    Raises:
        InputError: the source is not sought, or no message is late, or UAVs hear each other.
    """
    if not config.seeks_source:
        raise InputError("reward: nothing is won by finding the source, so that no belief bounds what is won")
    should = "is not supported: the rows compare what the server can know; choose links=server"
    checks.require(config.links.kind == "server", "links", config.links.kind, should)
    if not has_message_delay(config):
        raise InputError("delay.obs: no message is late or lost; choose a delay such as delay=paper")


def _believing(config: TrainConfig, own: bool) -> ScenarioConfig:
    """The scenario of an evaluation in which the server, or each UAV, keeps a belief."""
    features = config.observation.belief or ["belief_moments"]
    return replace(config.eval_scenario, observation=replace(config.observation, own=own, belief=features))


def _script(config: TrainConfig, scenario: ScenarioConfig, true_place: bool) -> Evaluation:
    """Evaluate the script in a scenario, in the same episodes at every call."""
    env = make_env(scenario, config.eval_episodes, config.eval_seed, config.device, ["message", "state"])
    script: TensorDictModuleBase = greedy_policy(env)
    if true_place:
        script = TensorDictSequential([true_belief(env), script])  # type: ignore[list-item]
    return evaluate(env, script, config.horizon)


def true_belief(env: DelayedEnv) -> TensorDictModule:
    """A module that replaces the server's belief by certainty about the source's cell.

    Args:
        env: its scenario observes a belief, and ``state`` is among its extras.
    """
    server = env.server
    grid = cast(SourceGrid, server.grid)

    def know(state: Tensor, message: Tensor) -> Tensor:
        inside = grid.prior[server.region_of(server.messages(message))] > 0
        distance = torch.cdist(state[..., -2:].to(grid.centres), grid.centres)
        return one_hot(distance.where(inside, torch.inf).argmin(-1), distance.shape[-1]).to(distance)

    return TensorDictModule(know, in_keys=[keys.STATE, keys.MESSAGE], out_keys=[keys.BELIEF])


@hydra.main(version_base=None, config_path=CONF, config_name="train")
@reported
def main(composed: DictConfig) -> None:
    for key in ("resume", "checkpoint"):
        if composed[key] is not None:
            raise InputError(f"{key}: the script flies, which is not trained; leave it out")
    perform(*prepare(composed), fly)


def run() -> None:
    """Run the program with the words of the command line."""
    launch(main)


if __name__ == "__main__":
    run()
