"""The environments for Gymnasium, which importing registers, and (in ``pettingzoo``) for
PettingZoo."""

import gymnasium

from damian.interop.gym import UavGymEnv, UavVectorEnv

__all__ = ["UavGymEnv", "UavVectorEnv"]

TASKS = ("spotting", "tracking", "coverage", "energy", "mixed")
"""Scenarios of conf/scenario that are registered, each as ``damian/NAME-v0``."""

for _task in TASKS:
    gymnasium.register(
        f"damian/{_task.capitalize()}-v0",
        entry_point="damian.recipes.shared.environments:gymnasium_env",
        vector_entry_point="damian.recipes.shared.environments:gymnasium_env",
        kwargs={"task": _task},
    )
