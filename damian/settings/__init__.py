"""All settings, as dataclasses that import without torch."""

from damian.settings.delays import ClockConfig, DelayConfig, LinkConfig
from damian.settings.learners import (
    LEARNERS,
    BpqlConfig,
    LearnerConfig,
    LearningSetup,
    MappoConfig,
    ModelConfig,
    PredictiveMappoConfig,
    SacConfig,
)
from damian.settings.scenario import ScenarioConfig
from damian.settings.server import EpisodeConfig, ObservationConfig, RewardConfig
from damian.settings.training import LoggerConfig, TrainConfig
from damian.settings.world import (
    ActionConfig,
    BatteryConfig,
    MotionConfig,
    RegionConfig,
    SourceConfig,
    WorldConfig,
)

__all__ = [
    "LEARNERS",
    "ActionConfig",
    "BatteryConfig",
    "BpqlConfig",
    "ClockConfig",
    "DelayConfig",
    "EpisodeConfig",
    "LearnerConfig",
    "LearningSetup",
    "LinkConfig",
    "LoggerConfig",
    "MappoConfig",
    "ModelConfig",
    "MotionConfig",
    "ObservationConfig",
    "PredictiveMappoConfig",
    "RegionConfig",
    "RewardConfig",
    "SacConfig",
    "ScenarioConfig",
    "SourceConfig",
    "TrainConfig",
    "WorldConfig",
]
