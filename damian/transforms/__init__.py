"""Delays, action histories and slow clocks as TorchRL transforms, on any TorchRL environment.

Only ``ServerNode``, ``Belief`` and ``SkipUntilReady`` (in ``damian.transforms.hold``) need a ``UavEnv``.
"""

import importlib
from typing import TYPE_CHECKING, Any

from damian.transforms.action import ActionDelay
from damian.transforms.base import StatefulTransform, check_order
from damian.transforms.channel import Channel
from damian.transforms.history import ActionHistory, MessageHistory
from damian.transforms.hold import SampleAndHold
from damian.transforms.observation import ObservationDelay
from damian.transforms.reward import CumulativeReward, RewardDelay
from damian.transforms.stored import delay_trajectories

if TYPE_CHECKING:
    from damian.transforms.server_node import Belief, ServerNode

__all__ = [
    "ActionDelay",
    "ActionHistory",
    "Belief",
    "Channel",
    "CumulativeReward",
    "MessageHistory",
    "ObservationDelay",
    "RewardDelay",
    "SampleAndHold",
    "ServerNode",
    "StatefulTransform",
    "check_order",
    "delay_trajectories",
]


def __getattr__(name: str) -> Any:
    if name not in ("Belief", "ServerNode"):  # these load the world of the UAVs
        raise AttributeError(f"module {__name__} has no attribute {name}")
    return getattr(importlib.import_module("damian.transforms.server_node"), name)
