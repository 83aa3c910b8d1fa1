"""Delays, action histories and slow clocks as TorchRL transforms, on any TorchRL environment.

Only ``ServerNode``, ``Belief``, and ``SkipUntilReady`` in ``damian.transforms.skip_until_ready``, need a
``UavEnv``. The world of the UAVs is loaded when one of the first two is first used.
"""

import importlib
from typing import TYPE_CHECKING, Any

from damian.transforms.action_delay import ActionDelay
from damian.transforms.action_history import ActionHistory
from damian.transforms.base import StatefulTransform
from damian.transforms.channel import Channel
from damian.transforms.message_history import MessageHistory
from damian.transforms.observation_delay import ObservationDelay
from damian.transforms.order import check_order
from damian.transforms.reward_delay import CumulativeReward, RewardDelay
from damian.transforms.sample_and_hold import SampleAndHold
from damian.transforms.stored import delay_trajectories

if TYPE_CHECKING:
    from damian.transforms.belief import Belief
    from damian.transforms.server_node import ServerNode

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
    if name not in _OF_UAVS:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    return getattr(importlib.import_module(_OF_UAVS[name]), name)


_OF_UAVS = {"Belief": "damian.transforms.belief", "ServerNode": "damian.transforms.server_node"}
"""Modules that load the world of the UAVs, by the transform in them."""
