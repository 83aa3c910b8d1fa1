"""Delays, action histories and slow clocks as TorchRL transforms.

All but ``ServerNode`` work on any TorchRL environment. One more, ``SkipUntilReady`` in
``damian.transforms.skip_until_ready``, works only in a ``DelayedEnv`` on a ``UavEnv``.
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
