"""Scenarios with every kind of delay and clock, and how tests step them."""

import pytest
import torch
from delay_twin import Crowd
from helpers import random_actions

from damian import ClockConfig, DelayConfig, make_env
from damian.envs.uav_env import EXTRAS
from damian.server.config import ObservationConfig

PAPER = {"law": "uniform", "low": "3s", "high": "7s", "probability": 0.15}
BURST = {
    "law": "burst",
    "enter": 0.2,
    "leave": 0.3,
    "bad": 4,
    "bad_loss": 0.3,
}
DELAYS = {
    "paper": {"delay": DelayConfig(obs=PAPER)},
    "burst": {
        "delay": DelayConfig(
            obs=BURST,
            act={"law": "geometric", "mean": 1},
            order="arrival",
        )
    },
    "everything": {
        "delay": DelayConfig(
            obs=3,
            act=2,
            rew=1,
            history=4,
            loss=0.1,
            reward_window=3,
        )
    },
    "slow clocks": {
        "delay": DelayConfig(
            obs=PAPER,
            act="0..2",
            history=2,
        ),
        "clock": ClockConfig(agents="2s", server="4s"),
    },
    "belief": {
        "delay": DelayConfig(obs=PAPER, loss=0.1),
        "observation": ObservationConfig(own=True, belief=["belief_moments", "belief_map"]),
    },
    "context": {
        "delay": DelayConfig(
            obs=Crowd(),
            act=Crowd(column=1),
            rew=Crowd(loses=False),
            loss=0.1,
        )
    },
}
every_delay = pytest.mark.parametrize("delays", DELAYS)


def delayed(scenario, n_worlds=4, **options):
    return make_env(scenario, n_worlds, extras=EXTRAS, **options)


def choices(env, n_steps):
    """Random actions, the same at each call."""
    generator = torch.Generator().manual_seed(3)
    return [random_actions(env, generator) for _ in range(n_steps)]


def after_steps(outputs, key):
    """An entry of the outputs of ``play`` after each step, [T, B, ...]."""
    return torch.stack([td[key] for td in outputs[1::2]])
