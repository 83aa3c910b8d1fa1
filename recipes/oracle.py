"""Fly a trained policy under delay, but with some of the messages on time: whose lateness costs what.

    python recipes/oracle.py checkpoint=runs/delaybench/tracking/none/undelayed/seed_8 delay=paper

What the policy acts on is more than it could know (regime R3 of a report). Overrides of the training run hold
where no others are given. The run folder gets config.yaml, result.csv and result.md.
"""

from pathlib import Path

import hydra
import torch
from evaluate import stored_actor
from launch import launch, prepare, reported, save_config
from omegaconf import DictConfig
from settings import CONF, TrainConfig
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.envs import StepCounter

from damian.delayed import make_env, messages_are_late
from damian.errors import InputError
from damian.features import Snapshot
from damian.metrics import evaluate
from damian.runs import save_results
from damian.server import Server


def foresee(config: TrainConfig, folder: Path) -> None:
    """Evaluate with nobody's messages on time, a UAV's own, the others', everybody's; fill the folder."""
    if not messages_are_late(config):
        raise InputError("delay.obs: nothing is late: there is nothing to know earlier")
    actor, seed = stored_actor(config), config.seed + 10_000
    save_config(config, folder)
    env = make_env(config, config.eval_episodes, seed, config.device, ["message"])
    env.append_transform(StepCounter())
    own = torch.eye(config.agents, dtype=torch.bool, device=env.device)
    whose = {"nobody's": own & ~own, "its own": own, "the others'": ~own, "everybody's": own | ~own}
    rows = {}
    for name, on_time in whose.items():
        env.set_seed(seed)  # the same episodes for everyone
        policy = TensorDictSequential([informed(env.worlds.server, on_time), actor])  # type: ignore[list-item]
        rows[name] = evaluate(env, policy, config.horizon)
    table = save_results(rows, folder, config.episode.success_share is not None, late=True)
    print(f"\nmessages that are on time:\n\n{table}")


def informed(server: Server, on_time: Tensor) -> TensorDictModule:
    """Shows each UAV what the server would tell it if messages had come, by viewer and sender [N, N]."""

    def see(received: Tensor, message: Tensor, shown: Tensor, steps: Tensor) -> Tensor:
        rows = torch.where(on_time.unsqueeze(-1), message.unsqueeze(1), received.unsqueeze(1))
        told = server.serve(Snapshot.unpack(rows), steps.expand(rows.shape[:2])).observation  # [B, N, N, F]
        own = told.diagonal(dim1=1, dim2=2).movedim(-1, 1)
        return torch.cat([own, shown[..., own.shape[-1] :]], -1)  # what it remembers by itself stays

    names = ("received", "message", "observation")
    keys = [*(("agents", name) for name in names), "step_count"]
    return TensorDictModule(see, in_keys=keys, out_keys=[("agents", "observation")])


@hydra.main(version_base=None, config_path=CONF, config_name="train")
@reported
def main(written: DictConfig) -> None:
    config, folder = prepare(written)
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    foresee(config, folder)


if __name__ == "__main__":
    launch(main)
