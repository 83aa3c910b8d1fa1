"""DAMIAN: delay-aware multi-UAV reinforcement learning on TorchRL.

The names below are loaded when they are first used, because TorchRL takes seconds to import.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from damian.delays.config import DelayConfig as DelayConfig
    from damian.delays.laws import (
        Burst as Burst,
        Constant as Constant,
        Distance as Distance,
        Geometric as Geometric,
        Lag as Lag,
        Law as Law,
        Trace as Trace,
        Uniform as Uniform,
    )
    from damian.delays.samplers import (
        ContextSampler as ContextSampler,
        MessageContext as MessageContext,
        Sampler as Sampler,
        TableSampler as TableSampler,
    )
    from damian.envs.config import ClockConfig as ClockConfig, ScenarioConfig as ScenarioConfig
    from damian.envs.nodes import ServerNode as ServerNode
    from damian.envs.pipeline import make_env as make_env
    from damian.envs.uav_env import UavEnv as UavEnv
    from damian.learners.config import (
        LearnerConfig as LearnerConfig,
        LearningSetup as LearningSetup,
    )
    from damian.models.config import ModelConfig as ModelConfig
    from damian.recipes.evaluate import load as load  # type: ignore[import-not-found]
    from damian.recipes.results import results as results  # type: ignore[import-not-found]
    from damian.recipes.shared.environments import compose_scenario as compose_scenario  # type: ignore[import-not-found]
    from damian.replay.backupdate import BackupdateStorage as BackupdateStorage
    from damian.runs.measures import metric as metric
    from damian.server.features import feature as feature
    from damian.server.rewards import reward_term as reward_term
    from damian.transforms import (
        ActionDelay as ActionDelay,
        ActionHistory as ActionHistory,
        Channel as Channel,
        CumulativeReward as CumulativeReward,
        ObservationDelay as ObservationDelay,
        ObservationTimeline as ObservationTimeline,
        RewardDelay as RewardDelay,
        SampleAndHold as SampleAndHold,
        set_seed as set_seed,
    )
    from damian.world.sensors import sensor as sensor

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL reads it when it is imported

__version__ = "0.19.0"

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
    "damian.models.config": ["ModelConfig"],
    "damian.envs.uav_env": ["UavEnv"],
    "damian.recipes.evaluate": ["load"],
    "damian.runs.measures": ["metric"],
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


def __dir__() -> list[str]:
    return [*globals(), *_MODULE_OF]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module damian has no attribute {name}")
    return getattr(import_module(_MODULE_OF[name]), name)
