"""Scenarios with every kind of delay and clock, and how tests step them."""

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from delay_twin import Crowd
from helpers import random_actions
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from damian import ClockConfig, DelayConfig, ScenarioConfig, make_env
from damian.envs.uav_env import EXTRAS
from damian.server.config import ObservationConfig

PAPER = {"law": "uniform", "low": "3s", "high": "7s", "probability": 0.15}
BURST = {"law": "burst", "enter": 0.2, "leave": 0.3, "bad": 4, "bad_loss": 0.3}
DELAYS = {
    "paper": {"delay": DelayConfig(obs=PAPER)},
    "burst": {
        "delay": DelayConfig(obs=BURST, act={"law": "geometric", "mean": 1}, order="arrival")
    },
    "everything": {"delay": DelayConfig(obs=3, act=2, rew=1, history=4, loss=0.1, reward_window=3)},
    "slow clocks": {
        "delay": DelayConfig(obs=PAPER, act={"law": "uniform", "high": 2}, history=2),
        "clock": ClockConfig(agents="2s", server="4s"),
    },
    "belief": {
        "delay": DelayConfig(obs=PAPER, loss=0.1),
        "observation": ObservationConfig(own=True, belief=["belief_moments", "belief_map"]),
    },
    "context": {
        "delay": DelayConfig(obs=Crowd(), act=Crowd(column=1), rew=Crowd(loses=False), loss=0.1)
    },
}
every_delay = pytest.mark.parametrize("delays", DELAYS)


def delayed(scenario: ScenarioConfig, n_worlds: int = 4, **options: Any) -> EnvBase:
    return make_env(scenario, n_worlds, extras=EXTRAS, **options)


def choices(env: EnvBase, n_steps: int) -> list[Tensor]:
    """Random actions, the same at each call."""
    generator = torch.Generator().manual_seed(3)
    return [random_actions(env, generator) for _ in range(n_steps)]


def after_steps(outputs: Sequence[TensorDictBase], key: Any) -> Tensor:
    """An entry of the outputs of ``play`` after each step, [T, B, ...]."""
    return torch.stack([td[key] for td in outputs[1::2]])
