"""The environments of the command line, for Python programs, notebooks and ``gymnasium.make``.

env = damian.make_env(damian.compose_scenario("scenario=tracking", "delay=paper"), num_worlds=64)
"""

from collections.abc import Sequence
from typing import Any

from damian.envs.config import ScenarioConfig
from damian.interop.gym import UavGymEnv, UavVectorEnv

from ..cli import settings


def compose_scenario(*overrides: str) -> ScenarioConfig:
    """The scenario of ``damian train`` with overrides such as ``scenario=tracking``,
    ``agents=5``."""
    return settings(*overrides)


def gymnasium_env(
    task: str, overrides: Sequence[str] = (), num_envs: int | None = None, **options: Any
) -> UavGymEnv | UavVectorEnv:
    """A task with one UAV, for ``gymnasium.make("damian/Spotting-v0", overrides=["delay.obs=3"])``.

    With ``num_envs`` it is many worlds, as ``gymnasium.make_vec("damian/Spotting-v0",
    num_envs=1024)`` makes them. ``options`` are further ones of ``UavGymEnv``
    (``seed``, ``render_mode``), or ``seed``.
    """
    scenario = compose_scenario(f"scenario={task}", "agents=1", *overrides)
    if num_envs is None:
        return UavGymEnv(scenario, **options)
    return UavVectorEnv(scenario, num_envs, **options)
