"""The environments for PettingZoo and Gymnasium; importing this registers ``damian/Spotting-v0``."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:
    from damian.interop.delay_wrapper import DelayWrapper
    from damian.interop.gym import UavGymEnv, UavVectorEnv
    from damian.interop.pettingzoo import UavParallelEnv

__all__ = ["DelayWrapper", "UavGymEnv", "UavParallelEnv", "UavVectorEnv"]

TASKS = ("spotting", "tracking", "coverage", "energy", "mixed")
"""Scenarios of conf/scenario that are registered, each as ``damian/NAME-v0``."""
_MODULES = {
    "DelayWrapper": "delay_wrapper",
    "UavGymEnv": "gym",
    "UavParallelEnv": "pettingzoo",
    "UavVectorEnv": "gym",
}

for _task in TASKS:
    gymnasium.register(
        f"damian/{_task.capitalize()}-v0",
        entry_point="damian.recipes.shared.environments:gymnasium_env",
        vector_entry_point="damian.recipes.shared.environments:gymnasium_env",
        kwargs={"task": _task},
    )


def __getattr__(name: str) -> Any:
    """Load a class when it is first used: PettingZoo need not be installed."""
    if name not in _MODULES:
        raise AttributeError(f"module damian.interop has no attribute {name}")
    return getattr(import_module(f"damian.interop.{_MODULES[name]}"), name)
