"""The environments for PettingZoo and Gymnasium; importing this registers ``damian/Spotting-v0``."""

from typing import TYPE_CHECKING, Any

import gymnasium

from damian.interop.delay_wrapper import DelayWrapper
from damian.interop.gym import UavGymEnv, UavVectorEnv

if TYPE_CHECKING:
    from damian.interop.pettingzoo import UavParallelEnv

__all__ = ["DelayWrapper", "UavGymEnv", "UavParallelEnv", "UavVectorEnv"]

TASKS = ("spotting", "tracking", "coverage", "energy", "mixed")
"""Scenarios of conf/scenario that are registered, each as ``damian/NAME-v0``."""

for _task in TASKS:
    gymnasium.register(
        f"damian/{_task.capitalize()}-v0",
        entry_point="damian.recipes.shared.environments:gymnasium_env",
        vector_entry_point="damian.recipes.shared.environments:gymnasium_env",
        kwargs={"task": _task},
    )


def __getattr__(name: str) -> Any:
    if name != "UavParallelEnv":
        raise AttributeError(f"module damian.interop has no attribute {name}")
    from damian.interop.pettingzoo import UavParallelEnv  # noqa: PLC0415 (PettingZoo need not be installed)

    return UavParallelEnv
