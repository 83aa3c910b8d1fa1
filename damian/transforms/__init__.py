"""Delays, memories and clocks as TorchRL transforms; all but ``ServerNode`` work on any environment."""

from damian.transforms.action import ActionDelay
from damian.transforms.clock import Clock
from damian.transforms.history import ActionHistory
from damian.transforms.observation import ObservationDelay
from damian.transforms.reward import CumulativeReward, RewardDelay
from damian.transforms.server_node import ServerNode
from damian.transforms.stateful import Stateful, check_order

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
