"""Delays, memories and clocks as TorchRL transforms; all but ``ServerNode`` work on any environment."""

from damian.transforms.action_delay import ActionDelay
from damian.transforms.action_history import ActionHistory
from damian.transforms.base import Stateful, check_order
from damian.transforms.observation_delay import ObservationDelay
from damian.transforms.reward_delay import CumulativeReward, RewardDelay
from damian.transforms.sample_and_hold import Clock
from damian.transforms.server_node import ServerNode

__all__ = [
    "ActionDelay",
    "ActionHistory",
    "Clock",
    "CumulativeReward",
    "ObservationDelay",
    "RewardDelay",
    "ServerNode",
    "Stateful",
    "check_order",
]
