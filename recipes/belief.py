"""Draw where the server believes the UAVs to be, and where they are, in one episode of the random policy.

    damian belief
    damian belief delay=paper scenario=tracking agents=2 seed=1
    damian belief delay.obs=3 delay.loss=0.2 motion=polynomial

Every override of damian train may be given, except resume and checkpoint. The run folder gets config.yaml,
belief.png (a map, the positions over time, the age of information) and belief.csv (a row for each time and
UAV).
"""

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor

from damian import keys
from damian.baselines.random import random_policy
from damian.common.errors import InputError
from damian.envs.pipeline import make_env
from damian.envs.uav_env import UavEnv
from damian.evaluation.belief_figure import Beliefs, plot_beliefs

from .shared.known_settings import CONF
from .shared.launch import launch, perform, prepare, reported
from .shared.settings import TrainConfig
from .shared.stored_runs import save_config

TABLE, FIGURE = "belief.csv", "belief.png"
POSITIONS = ("true_east_m", "true_north_m", "believed_east_m", "believed_north_m")
COLUMNS = ("time_s", "uav", *POSITIONS, "age_s", "arrived", "lost")


def fly(config: TrainConfig) -> Beliefs:
    """Fly one episode of the random policy."""
    env = make_env(
        config.eval_scenario, 1, config.seed, config.device, extras=["message", "state", "reward_terms"]
    )
    rollout = env.rollout(config.horizon, random_policy(env))[0].cpu()
    needed = [keys.STATE, keys.MESSAGE, keys.MESSAGE_SENT, keys.RECEIVED, keys.DELAY]
    outputs = [part.select(*needed, strict=False) for part in (rollout[:1], rollout["next"])]
    return beliefs(cast(TensorDictBase, torch.cat(outputs)), env.uav_env)  # type: ignore[arg-type]


def beliefs(outputs: TensorDictBase, env: UavEnv) -> Beliefs:
    """True and believed positions, with the messages between them.

    Args:
        outputs: of the environment at the reset and after each step, [T + 1].
        env: the environment without delays.
    """
    message, state = cast(Tensor, outputs[keys.MESSAGE]), cast(Tensor, outputs[keys.STATE])
    sent = cast(Tensor, outputs[keys.MESSAGE_SENT]).clone()
    sent[0] = False  # the server holds the first message from the reset on
    delay = outputs.get(keys.DELAY, torch.zeros_like(sent[..., None], dtype=torch.long))
    held = env.server.messages(outputs.get(keys.RECEIVED, message))
    dt, steps = env.scenario.clock.dt, torch.arange(len(state), dtype=torch.float64)
    positions = state[:, : 3 * env.n_agents].unflatten(-1, (env.n_agents, 3))[..., :2]
    return Beliefs(
        time=np.asarray(steps * dt),
        true=np.asarray(positions),
        believed=np.asarray(held.position),
        age=np.asarray((held.age(steps * dt) / dt).round() * dt),  # times in messages are float32
        sent=np.asarray(sent),
        delay=np.asarray(delay[..., 0]),
        source=np.asarray(state[:, -2:]),
        region=env.simulation.airspace.regions[int(env.state.region)].polygon,
        radius=env.simulation.radius,
        instant=env.simulation.vehicles.instant,
    )


def rows(flight: Beliefs) -> Iterator[tuple[float | int, ...]]:
    """Rows of the table under ``COLUMNS``: one for each time and UAV."""
    arrived, lost = flight.arrived.astype(int), flight.lost.astype(int)
    for step, uav in np.ndindex(flight.age.shape):
        positions = (*flight.true[step, uav].tolist(), *flight.believed[step, uav].tolist())
        time, age = float(flight.time[step]), float(flight.age[step, uav])
        yield (time, uav, *positions, age, int(arrived[step, uav]), int(lost[step, uav]))


def report(flight: Beliefs, folder: Path) -> None:
    """Write table and figure; print the mean age of information, and the shares of late and lost messages."""
    with (folder / TABLE).open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        writer.writerows(rows(flight))
    plot_beliefs(flight, folder / FIGURE)
    n_sent = max(int(flight.sent.sum()), 1)
    print(f"mean age: {flight.age.mean():.2f} s")
    print(f"late messages: {flight.late.sum() / n_sent:.1%}")
    print(f"lost messages: {flight.lost.sum() / n_sent:.1%}")


def show(config: TrainConfig, folder: Path) -> None:
    """Fly one episode and fill the run folder."""
    flight = fly(config)
    save_config(config, folder)
    report(flight, folder)


@hydra.main(version_base=None, config_path=CONF, config_name="belief")
@reported
def main(composed: DictConfig) -> None:
    for key in ("resume", "checkpoint"):
        if composed[key] is not None:
            raise InputError(f"{key}: the random policy flies, which is not trained; leave it out")
    perform(*prepare(composed), show)


def run() -> None:
    """Run the program with the words of the command line."""
    launch(main)


if __name__ == "__main__":
    run()
