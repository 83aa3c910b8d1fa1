"""Fly a trained policy under delay, but knowing some things on time: whose lateness costs what.

    python recipes/oracle.py checkpoint=runs/delaybench/tracking/none/undelayed/seed_8 delay=paper

What the policy acts on is more than it could know (regime R3 of a report). Overrides of the training run hold
where no others are given. The run folder gets config.yaml, result.csv and result.md.
"""

from collections.abc import Sequence
from pathlib import Path

import hydra
import torch
from evaluate import stored
from omegaconf import DictConfig
from shared.launch import launch, perform, prepare, reported, save_config
from shared.settings import CONF, TrainConfig
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.envs import StepCounter

from damian import keys
from damian.common.errors import InputError
from damian.envs.pipeline import has_message_delay
from damian.evaluation.metrics import evaluate
from damian.evaluation.run_folder import save_results
from damian.server.server import Server
from damian.world.messages import Messages

ALL = Messages._fields
PLACE = ("position", "target", "track", "trail")
"""What a UAV can tell from its own past actions; what it has heard is not among it."""


def foresee(config: TrainConfig, folder: Path) -> None:
    """Evaluate with more and more that is known on time, and fill the folder."""
    if not has_message_delay(config):
        raise InputError("delay.obs: nothing is late: there is nothing to know earlier")
    env, actor = stored(config)
    save_config(config, folder)
    env.append_transform(StepCounter())
    own = torch.eye(config.agents, dtype=torch.bool, device=env.device)
    whose = {
        "nothing": (own & ~own, ALL),
        "where it is": (own, PLACE),
        "its own messages": (own, ALL),
        "the others' messages": (~own, ALL),
        "everything": (own | ~own, ALL),
    }
    rows = {}
    for name, known in whose.items():
        env.set_seed(config.eval_seed)  # the same episodes for everyone
        policy = TensorDictSequential([observe_with_timely_messages(env.server, *known), actor])  # type: ignore[list-item]
        rows[name] = evaluate(env, policy, config.horizon)
    table = save_results(rows, folder, config.episode.success_share is not None, late=True)
    print(f"\nwhat a UAV knows on time:\n\n{table}")


def observe_with_timely_messages(server: Server, on_time: Tensor, fields: Sequence[str]) -> TensorDictModule:
    """Shows each UAV what the server would tell it if it had known some things on time.

    Args:
        server: of the environment.
        on_time: from whom, by who is told and who has sent, [N, N] bool.
        fields: of their messages.
    """

    def observe(received: Tensor, sent: Tensor, observation: Tensor, steps: Tensor) -> Tensor:
        timely = server.observe_with_timely_messages(received, sent, steps.squeeze(-1), on_time, fields)
        return torch.cat([timely, observation[..., timely.shape[-1] :]], -1)  # its own past actions stay

    in_keys = [keys.RECEIVED, keys.MESSAGE, keys.OBSERVATION, keys.STEP_COUNT]
    return TensorDictModule(observe, in_keys=in_keys, out_keys=[keys.OBSERVATION])


@hydra.main(version_base=None, config_path=CONF, config_name="train")
@reported
def main(composed: DictConfig) -> None:
    perform(*prepare(composed), foresee)


if __name__ == "__main__":
    launch(main)
