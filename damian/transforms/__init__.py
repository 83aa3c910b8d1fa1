"""Delays, memories and clocks as TorchRL transforms; all but ``ServerNode`` work on any environment.

``damian.transforms.skip_until_ready`` holds one more, which only a ``DelayedEnv`` on a ``UavEnv`` takes.
"""

from damian.transforms.action_delay import ActionDelay
from damian.transforms.action_history import ActionHistory
from damian.transforms.base import StatefulTransform
from damian.transforms.observation_delay import ObservationDelay
from damian.transforms.order import check_order
from damian.transforms.reward_delay import CumulativeReward, RewardDelay
from damian.transforms.sample_and_hold import SampleAndHold
from damian.transforms.server_node import ServerNode

__all__ = [
    "ActionDelay",
    "ActionHistory",
    "CumulativeReward",
    "ObservationDelay",
    "RewardDelay",
    "SampleAndHold",
    "ServerNode",
    "StatefulTransform",
    "check_order",
]
