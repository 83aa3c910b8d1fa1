"""Delays, action histories and slow clocks as TorchRL transforms, on any TorchRL environment."""

from damian.transforms.action import ActionDelay
from damian.transforms.base import StatefulTransform, set_seed
from damian.transforms.channel import Channel
from damian.transforms.history import ActionHistory
from damian.transforms.hold import SampleAndHold
from damian.transforms.observation import ObservationDelay
from damian.transforms.reward import CumulativeReward, RewardDelay
from damian.transforms.timeline import ObservationTimeline

__all__ = [
    "ActionDelay",
    "ActionHistory",
    "Channel",
    "CumulativeReward",
    "ObservationDelay",
    "ObservationTimeline",
    "RewardDelay",
    "SampleAndHold",
    "StatefulTransform",
    "set_seed",
]
