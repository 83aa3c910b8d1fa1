"""The environments of the command line, for Python programs, notebooks and ``gymnasium.make``.

env = damian.make_env(damian.compose_scenario("scenario=tracking", "delay=paper"), num_worlds=64)
"""

from collections.abc import Sequence
from typing import Any

from damian.envs.config import ScenarioConfig
from damian.interop.gym import UavGymEnv, UavVectorEnv

from ..cli import settings


def compose_scenario(*overrides: str) -> ScenarioConfig:
    """The scenario of ``damian train`` with overrides such as ``scenario=tracking``, ``agents=5``."""
    return settings(*overrides)


def gymnasium_env(task: str, overrides: Sequence[str] = (), **options: Any) -> UavGymEnv:
    """One UAV in a task, for ``gymnasium.make("damian/Spotting-v0", overrides=["delay.obs=3"])``.

    ``options`` are ``seed``, ``render_mode`` and ``view`` of ``UavGymEnv``.
    """
    return UavGymEnv(compose_scenario(f"scenario={task}", "agents=1", *overrides), **options)


def gymnasium_vector_env(task: str, overrides: Sequence[str] = (), **options: Any) -> UavVectorEnv:
    """Many worlds of a task with one UAV, for ``gymnasium.make_vec("damian/Spotting-v0", num_envs=1024)``.

    ``options`` are ``num_envs`` and ``seed`` of ``UavVectorEnv``.
    """
    return UavVectorEnv(compose_scenario(f"scenario={task}", "agents=1", *overrides), **options)
