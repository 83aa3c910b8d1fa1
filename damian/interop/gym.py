"""A Gymnasium environment of one UAV."""

from typing import Any, SupportsFloat, cast

import gymnasium
import numpy as np

from damian.common import checks
from damian.envs.config import ScenarioConfig
from damian.interop.flight import METADATA, Array, Flight, actions_in


class UavGymEnv(gymnasium.Env[Array, Any]):
    """One UAV of a scenario, with its delays, as a Gymnasium environment.

    Observations are float32 [F], rewards those that the server perceives; ``info`` has ``ready`` (may the UAV
    choose an action now; if not, its action changes nothing), ``is_success``, and, if actions are masked,
    ``action_mask`` [A] int8, as ``action_space.sample`` takes it. ``action_masks()`` is for sb3-contrib.

    Args:
        scenario: all settings, with ``agents=1``.
        seed: of the regions and initial conditions that are drawn now; ``reset(seed=...)`` decides the rest.
        render_mode: ``rgb_array``, or None.
        view: of the pictures: ``2d``, from above, or ``3d``.
    """

    metadata = METADATA

    def __init__(
        self, scenario: ScenarioConfig, seed: int = 0, render_mode: str | None = None, view: str = "2d"
    ) -> None:
        should = "is not 1: a Gymnasium environment has one agent; take damian.interop.UavParallelEnv"
        checks.require(scenario.agents == 1, "agents", scenario.agents, should)
        self.flight, self.render_mode = Flight(scenario, seed, render_mode, view), render_mode
        self.observation_space = self.flight.observation_space(0)
        self.action_space = self.flight.action_space()
        self._info: dict[str, Any] = {}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        instant = self.flight.reset(seed)
        self._info = instant.infos[0]
        return instant.observation[0], self._info

    def step(self, action: Any) -> tuple[Array, SupportsFloat, bool, bool, dict[str, Any]]:
        chosen = actions_in(self.action_space, "action", action)[None]
        observation, (reward,), terminated, truncated, (self._info,) = self.flight.step(chosen)
        return observation[0], reward, terminated, truncated, self._info

    def render(self) -> Any:
        return self.flight.render()

    def action_masks(self) -> Array:
        """Which discrete actions are legal now, [A] bool; all of them if nothing is masked."""
        space = cast(gymnasium.spaces.Discrete, self.action_space)
        return self._info.get("action_mask", np.ones(space.n)).astype(bool)
