"""Evaluate a trained policy under delay, with some messages known on time: which late messages cost how much.

    damian train scenario=tracking hydra.run.dir=runs/undelayed
    damian oracle checkpoint=runs/undelayed delay=paper
    damian oracle checkpoint=runs/undelayed delay.obs=4 agents=5

The policy acts on messages that have not arrived yet, so its results are a reference that no real system can
reach (regime R3, docs/protocol.md). The overrides of the training run apply too, unless the command line
gives others; a policy with a belief is refused. The run folder gets config.yaml, result.csv and result.md:
one row for each set of messages that a UAV knows on time.
"""

from collections.abc import Sequence
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.envs import StepCounter

from damian import keys
from damian.common import checks
from damian.common.errors import InputError
from damian.envs.pipeline import has_message_delay
from damian.runs.metrics import evaluate
from damian.runs.run_folder import save_results
from damian.server.server import Server
from damian.world.messages import Messages

from .evaluate import checkpoint_of, stored
from .shared.known_settings import CONF
from .shared.launch import launch, perform, prepare, reported
from .shared.settings import TrainConfig
from .shared.stored_runs import save_config

ALL = Messages._fields
PLACE = ("position", "target", "track", "trail")
"""Fields of a message that a UAV can compute from its own past actions; its detections are not among them."""


def foresee(config: TrainConfig, folder: Path) -> None:
    """Evaluate the policy with ever more messages known on time, and fill the run folder."""
    checkpoint_of(config)  # before the delays, because without it nothing can be compared
    if not has_message_delay(config):
        raise InputError("delay.obs: no message is late or lost; choose a delay such as delay=paper")
    should = "is not supported: the rows replace what the server broadcasts; choose links=server"
    checks.require(config.links.kind == "server", "links", config.links.kind, should)
    should = "is not supported: the rows replace what the server broadcasts at every step; leave it out"
    checks.require(config.clock.steps("server") == 1, "clock.server", config.clock.server, should)
    follows = "what a UAV believes follows from more messages than the latest ones"
    should = f"is not supported: {follows}; choose a policy that was trained without it"
    for key, value in (
        ("observation.belief", config.observation.belief),
        ("delay.messages", config.delay.messages),
    ):
        checks.require(not value, key, value, should)
    env, actor = stored(config)
    save_config(config, folder)
    env.append_transform(StepCounter())
    own = torch.eye(config.agents, dtype=torch.bool, device=env.device)
    known_on_time = {
        "nothing": (own & ~own, ALL),
        "where it is": (own, PLACE),
        "its own messages": (own, ALL),
        "the others' messages": (~own, ALL),
        "everything": (own | ~own, ALL),
    }
    rows = {}
    for name, (on_time, message_fields) in known_on_time.items():
        env.set_seed(config.eval_seed)  # the same episodes for every row
        observe = observe_with_timely_messages(env.server, on_time, message_fields)
        policy = TensorDictSequential([observe, actor])  # type: ignore[list-item]
        rows[name] = evaluate(env, policy, config.horizon)
    table = save_results(rows, folder, config.episode.success_share is not None, late=True)
    print(f"\nwhat a UAV knows on time:\n\n{table}")


def observe_with_timely_messages(server: Server, on_time: Tensor, fields: Sequence[str]) -> TensorDictModule:
    """A module that replaces the actor's observations by those with some messages known on time.

    Args:
        server: the server of the environment.
        on_time: row i, column j: does UAV i know UAV j's latest message at once, [N, N] bool.
        fields: fields of the messages that are known at once.
    """

    def observe(received: Tensor, sent: Tensor, observation: Tensor, steps: Tensor) -> Tensor:
        timely = server.observe_with_timely_messages(received, sent, steps.squeeze(-1), on_time, fields)
        return torch.cat([timely, observation[..., timely.shape[-1] :]], -1)  # keep the action history

    in_keys = [keys.RECEIVED, keys.MESSAGE, keys.OBSERVATION, keys.STEP_COUNT]
    return TensorDictModule(observe, in_keys=in_keys, out_keys=[keys.OBSERVATION])


@hydra.main(version_base=None, config_path=CONF, config_name="train")
@reported
def main(composed: DictConfig) -> None:
    perform(*prepare(composed), foresee)


def run() -> None:
    """Run the program with the words of the command line."""
    launch(main)


if __name__ == "__main__":
    run()
