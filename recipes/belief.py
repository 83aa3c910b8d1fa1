"""What the server believes of the UAVs, beside what is true: one flight of the random policy, drawn.

    python recipes/belief.py
    python recipes/belief.py delay=paper scenario=tracking agents=2 seed=1
    python recipes/belief.py delay.obs=3 delay.loss=0.2 motion=polynomial motion.max_speed=20

Takes what recipes/train.py takes; a flight lasts as long as an episode. The run folder explains itself:
config.yaml, belief.png, and belief.csv with a row for each instant and UAV.
"""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import hydra
import torch
from launch import CONF, TrainConfig, launch, prepare, reported, save_config
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor

from damian.delayed import make_env
from damian.env import UavEnv
from damian.errors import InputError
from damian.features import Snapshot
from damian.figures import Beliefs, plot_beliefs
from damian.models import random_policy

TABLE, FIGURE = "belief.csv", "belief.png"
POSITIONS = ("true_east_m", "true_north_m", "believed_east_m", "believed_north_m")
COLUMNS = ("time_s", "uav", *POSITIONS, "age_s", "arrived", "lost")


@dataclass
class Flight:
    """One flight as the environment showed it: T steps, T + 1 instants, N UAVs."""

    env: UavEnv
    """In the flight's last state."""
    shown: TensorDictBase
    """[T + 1]."""

    @property
    def sent(self) -> Snapshot:
        """The latest message of each UAV, [T + 1, N]."""
        return Snapshot.unpack(self.shown["agents", "message"])

    @property
    def received(self) -> Snapshot:
        """The message of each UAV that the server holds, [T + 1, N]; the latest, if nothing is late."""
        key = "received" if "received" in self.shown["agents"].keys() else "message"
        return Snapshot.unpack(self.shown["agents", key])

    @property
    def talks(self) -> Tensor:
        """Was a message sent just now, [T + 1, N]; the first one needs no channel."""
        talks = self.shown["agents", "talks"].clone()
        talks[0] = False
        return talks

    @property
    def delay(self) -> Tensor:
        """Of the messages sent just now [steps], [T + 1, N]; -1 if lost, or not sent at all."""
        delay = self.shown["agents"].get("delay", None)
        return torch.where(self.talks, 0, -1) if delay is None else torch.where(self.talks, delay[..., 0], -1)

    @property
    def arrived(self) -> Tensor:
        """Did a message arrive just now, if only to find a newer one there, [T + 1, N]."""
        step, uav = torch.nonzero(self.delay >= 0, as_tuple=True)
        arrives = step + self.delay[step, uav]
        counts = torch.zeros(int(arrives.max()) + 1)

