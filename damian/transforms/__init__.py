"""Delays, action histories and slow clocks as TorchRL transforms, on any TorchRL environment.

Only ``ServerNode``, and ``SkipUntilReady`` in ``damian.transforms.skip_until_ready``, need a ``UavEnv``. The
world of the UAVs is loaded when ``ServerNode`` is first used.
"""

from typing import TYPE_CHECKING, Any

from damian.transforms.action_delay import ActionDelay
from damian.transforms.action_history import ActionHistory
from damian.transforms.base import StatefulTransform
from damian.transforms.channel import Channel
from damian.transforms.observation_delay import ObservationDelay
from damian.transforms.order import check_order
from damian.transforms.reward_delay import CumulativeReward, RewardDelay
from damian.transforms.sample_and_hold import SampleAndHold
from damian.transforms.stored import delay_trajectories

if TYPE_CHECKING:
    from damian.transforms.server_node import ServerNode

__all__ = [
    "ActionDelay",
    "ActionHistory",
    "Channel",
    "CumulativeReward",
    "ObservationDelay",
    "RewardDelay",
    "SampleAndHold",
    "ServerNode",
    "StatefulTransform",
    "check_order",
    "delay_trajectories",
]


def __getattr__(name: str) -> Any:
    if name != "ServerNode":
        raise AttributeError(f"module {__name__} has no attribute {name}")
    from damian.transforms.server_node import ServerNode  # noqa: PLC0415 (it loads the world of the UAVs)

    return ServerNode
