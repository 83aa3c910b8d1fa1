"""A Gymnasium vector environment: many worlds of one UAV, stepped as one batch."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from damian.common import checks
from damian.envs.scenario import ScenarioConfig
from damian.interop.flight import Array, Flight, actions_in, one_uav


class UavVectorEnv(gymnasium.vector.VectorEnv[Array, Any, Array]):
    """B worlds of one UAV as a Gymnasium vector environment.

    A world whose episode ends begins a new one in the same step (``AutoresetMode.SAME_STEP``); ``infos`` then
    has its last observation as ``final_obs``, and its last infos as ``final_info``. World number i equals a
    ``UavGymEnv`` that is reset with ``seed + i``.

    Args:
        scenario: all settings, with ``agents=1``.
        num_envs: number of worlds, B.
        seed: of the regions and initial conditions that are drawn now; ``reset(seed=...)`` decides the rest.

    Raises:
        InputError: the scenario has several UAVs, or asks for something impossible.
    """

    def __init__(self, scenario: ScenarioConfig, num_envs: int = 1, seed: int = 0) -> None:
        one_uav(scenario)
        checks.in_range("num_envs", num_envs, 1, checks.WORLDS)
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.num_envs, self.flight = num_envs, Flight(scenario, num_envs, seed)
        self.single_observation_space = self.flight.observation_space(0)
        self.single_action_space = self.flight.action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        checks.require(not isinstance(seed, list), "seed", seed, "is a list: world i draws from seed + i")
        instant = self.flight.reset(seed)  # type: ignore[arg-type]
        return instant.observation[:, 0], _infos(instant.infos)

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        chosen = actions_in(self.action_space, "actions", actions)
        last, instant = self.flight.step(chosen[:, None], reset=True)
        infos, done = _infos(instant.infos), last.terminated | last.truncated
        if done.any():
            final = np.full(self.num_envs, None, object)
            for world in done.nonzero()[0]:
                final[world] = last.observation[world, 0]
            infos |= {"final_obs": final, "_final_obs": done}
            infos |= {"final_info": _infos(last.infos, done), "_final_info": done}
        return instant.observation[:, 0], last.reward[:, 0], last.terminated, last.truncated, infos


def _infos(infos: dict[str, Array], worlds: Array | None = None) -> dict[str, Any]:
    """Infos of the worlds [B, ...] by name, each with a mask of the worlds [B] that have it (all)."""
    found = {name: each if name == "is_success" else each[:, 0] for name, each in infos.items()}
    mask = np.ones(len(infos["ready"]), bool) if worlds is None else worlds
    return found | {f"_{name}": mask.copy() for name in found}
