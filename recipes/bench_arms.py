"""The environments that ``damian bench`` compares: two scenarios, with each kind of delay, and VMAS."""

import importlib.util
from dataclasses import replace
from typing import Any

from torch import nn
from torchrl.envs import EnvBase
from torchrl.envs.libs.vmas import VmasEnv

from damian.delays.config import DelayConfig
from damian.envs.clocks import ClockConfig
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.envs.scenario import ScenarioConfig
from damian.learners.networks import ModelConfig, make_actor
from damian.server.features import GLOBAL, LOCAL, ObservationConfig
from damian.server.rewards import INDIVIDUAL, SYSTEM, RewardConfig
from damian.server.termination import EpisodeConfig
from damian.world.battery import BatteryConfig
from damian.world.motion import MotionConfig

from .bench_training import vmas_actor
from .shared.launch import composed_config
from .shared.settings import TrainConfig

RIVAL, LIMITED = "VMAS discovery, episodes never end", "VMAS discovery, episodes of 100 steps"
BARE, WHOLE = "bare", "whole chain"
NO_BELIEF = "no belief"

Scenarios = dict[str, ScenarioConfig]


def scenarios() -> Scenarios:
    """The paper's use case 2 (section 5.2), and the same region with every feature, reward and model on."""
    paper = _paper()
    full = replace(
        paper,
        region=replace(paper.region, start_positions=None, start_together=False, initial_conditions=1024),
        motion=MotionConfig(kind="polynomial"),
        battery=BatteryConfig(enabled=True),
        actions=replace(paper.actions, mask=True),
        observation=ObservationConfig(list(LOCAL), list(GLOBAL), ctde=True),
        reward=RewardConfig(**dict.fromkeys((*INDIVIDUAL, *SYSTEM), 1.0)),
        episode=EpisodeConfig(max_steps=100),
    )
    return {"use case 2": paper, "everything": full}


def believing() -> Scenarios:
    """The tracking task of delaybench without a belief, with the server's, and with that of each UAV too."""
    plain = composed_config("scenario=delaybench/tracking")
    features = {"belief": ["belief_gain", "belief_moments"]}
    changes = {
        NO_BELIEF: {},
        "the server's belief": features,
        "that of each UAV too": features | {"own": True},
    }
    return {
        name: replace(plain, observation=replace(plain.observation, **changed))
        for name, changed in changes.items()
    }


def _paper() -> TrainConfig:
    return composed_config("scenario=paper/usecase2", "model.hidden=[64,64]")


def fleet(scenario: ScenarioConfig, agents: int) -> ScenarioConfig:
    """The scenario with another number of UAVs, which start at random ones of 372 landing points."""
    start = {"start_positions": None, "start_together": False, "initial_conditions": 1024}
    return replace(
        scenario,
        agents=agents,
        region=replace(scenario.region, lattice_step=15.0, **start),
        motion=replace(scenario.motion, max_level=30.0, level_separation=0.2),  # room for 100 flight levels
    )


def delays() -> dict[str, dict[str, Any]]:
    """Changes to a scenario by name; "whole chain" is the paper's delay with an action history of four."""
    paper = {"law": "uniform", "low": "3s", "high": "7s", "probability": 0.15}
    everything = DelayConfig(obs=paper, act=1, rew=2, history=4, loss=0.1, reward_window=3)
    slow = ClockConfig(agents="2s", server="4s")
    return {
        BARE: {},
        "ObservationDelay, ServerNode": {"delay": DelayConfig(obs=paper)},
        "ActionDelay": {"delay": DelayConfig(act=2)},
        "RewardDelay": {"delay": DelayConfig(rew=2)},
        "CumulativeReward": {"delay": DelayConfig(reward_window=3)},
        "Clock (agents, server)": {"clock": slow},
        "ActionHistory": {"delay": DelayConfig(history=4)},
        WHOLE: {"delay": DelayConfig(obs=paper, history=4)},
        "every transform": {"delay": everything, "clock": slow},
    }


def delayed(
    scenario: ScenarioConfig, changes: dict[str, Any], worlds: int, mode: str = "eager"
) -> DelayedEnv:
    """An environment of a scenario with some changes, eager or compiled."""
    env = make_env(replace(scenario, **changes), worlds)
    return env.compile() if mode == "compiled" else env


def arms(
    presets: Scenarios, worlds: int, kinds: tuple[str, ...], modes: tuple[str, ...]
) -> dict[str, EnvBase]:
    """Environments of each scenario with each kind of delay, in each mode."""
    return {
        f"{name}, {kind}, {mode}": delayed(scenario, delays()[kind], worlds, mode)
        for name, scenario in presets.items()
        for kind in kinds
        for mode in modes
    }


def rivals(worlds: int) -> dict[str, EnvBase]:
    """VMAS's discovery task with three agents, without and with ends; nothing if VMAS is not installed."""
    if not importlib.util.find_spec("vmas"):
        print("VMAS is not installed, so there are no ratios: pip install -e '.[bench]'")
        return {}
    options = {"num_envs": worlds, "n_agents": 3, "device": "cpu", "continuous_actions": True}
    return {
        RIVAL: VmasEnv("discovery", **options),
        LIMITED: VmasEnv("discovery", max_steps=100, **options),
    }


def policy_for(env: EnvBase) -> nn.Module:
    """A policy with two layers of 64 for an environment of ours, or of VMAS."""
    if isinstance(env, DelayedEnv):
        return make_actor(env, ModelConfig(hidden=[64, 64]))
    return vmas_actor(env, _paper())
