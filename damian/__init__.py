"""DAMIAN: delay-aware multi-UAV reinforcement learning on TorchRL.

The names below are loaded when they are first used, because TorchRL takes seconds to import.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from damian.delays.config import DelayConfig
    from damian.delays.laws import Burst, Constant, Distance, Geometric, Lag, Law, Trace, Uniform
    from damian.delays.samplers import ContextSampler, MessageContext, Sampler, TableSampler
    from damian.envs.config import ClockConfig, ScenarioConfig
    from damian.envs.nodes import ServerNode
    from damian.envs.pipeline import make_env
    from damian.envs.uav_env import UavEnv
    from damian.learners.config import LearnerConfig, LearningSetup
    from damian.recipes.evaluate import load  # type: ignore[import-not-found]
    from damian.recipes.results import results  # type: ignore[import-not-found]
    from damian.recipes.shared.environments import compose_scenario  # type: ignore[import-not-found]
    from damian.replay.backupdate import BackupdateStorage
    from damian.server.features import feature
    from damian.server.rewards import reward_term
    from damian.transforms import (
        ActionDelay,
        ActionHistory,
        Channel,
        CumulativeReward,
        ObservationDelay,
        ObservationTimeline,
        RewardDelay,
        SampleAndHold,
        set_seed,
    )
    from damian.world.sensors import sensor

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL reads it when it is imported

__version__ = "0.18.0.dev0"

_MODULES = {
    "damian.delays.laws": [
        "Burst",
        "Constant",
        "Distance",
        "Geometric",
        "Lag",
        "Law",
        "Trace",
        "Uniform",
    ],
    "damian.delays.samplers": ["ContextSampler", "MessageContext", "Sampler", "TableSampler"],
    "damian.delays.config": ["DelayConfig"],
    "damian.envs.config": ["ClockConfig", "ScenarioConfig"],
    "damian.envs.pipeline": ["make_env"],
    "damian.learners.config": ["LearnerConfig", "LearningSetup"],
    "damian.envs.uav_env": ["UavEnv"],
    "damian.recipes.evaluate": ["load"],
    "damian.recipes.results": ["results"],
    "damian.recipes.shared.environments": ["compose_scenario"],
    "damian.replay.backupdate": ["BackupdateStorage"],
    "damian.server.features": ["feature"],
    "damian.server.rewards": ["reward_term"],
    "damian.transforms": [
        "ActionDelay",
        "ActionHistory",
        "Channel",
        "CumulativeReward",
        "ObservationTimeline",
        "ObservationDelay",
        "RewardDelay",
        "SampleAndHold",
        "set_seed",
    ],
    "damian.envs.nodes": ["ServerNode"],
    "damian.world.sensors": ["sensor"],
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "ActionDelay",
    "ActionHistory",
    "BackupdateStorage",
    "Burst",
    "Channel",
    "ClockConfig",
    "Constant",
    "ContextSampler",
    "CumulativeReward",
    "DelayConfig",
    "Distance",
    "Geometric",
    "Lag",
    "Law",
    "LearnerConfig",
    "LearningSetup",
    "MessageContext",
    "ObservationDelay",
    "ObservationTimeline",
    "RewardDelay",
    "SampleAndHold",
    "Sampler",
    "ScenarioConfig",
    "ServerNode",
    "TableSampler",
    "Trace",
    "UavEnv",
    "Uniform",
    "compose_scenario",
    "feature",
    "load",
    "make_env",
    "results",
    "reward_term",
    "sensor",
    "set_seed",
]


def __dir__() -> list[str]:
    return [*globals(), *__all__]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module damian has no attribute {name}")
    return getattr(import_module(_MODULE_OF[name]), name)
