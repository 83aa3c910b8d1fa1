"""Delays, action histories and slow clocks as TorchRL transforms, on any TorchRL environment."""

from damian.transforms.action import ActionDelay as ActionDelay
from damian.transforms.base import StatefulTransform as StatefulTransform, set_seed as set_seed
from damian.transforms.channel import Channel as Channel
from damian.transforms.history import ActionHistory as ActionHistory
from damian.transforms.hold import SampleAndHold as SampleAndHold
from damian.transforms.observation import ObservationDelay as ObservationDelay
from damian.transforms.reward import (
    CumulativeReward as CumulativeReward,
    RewardDelay as RewardDelay,
)
from damian.transforms.timeline import ObservationTimeline as ObservationTimeline
