"""A Gymnasium environment of one UAV."""

from typing import Any, SupportsFloat

import gymnasium
import numpy as np

from damian.envs.scenario import ScenarioConfig
from damian.interop.flight import METADATA, Array, Flight, actions_in, one_uav, row


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

    Raises:
        InputError: the scenario has several UAVs, or asks for something impossible.
    """

    metadata = METADATA

    def __init__(
        self, scenario: ScenarioConfig, seed: int = 0, render_mode: str | None = None, view: str = "2d"
    ) -> None:
        one_uav(scenario)
        self.flight, self.render_mode = Flight(scenario, 1, seed, render_mode, view), render_mode
        self.observation_space = self.flight.observation_space(0)
        self.action_space = self.flight.action_space()
        self._info: dict[str, Any] = {}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        instant = self.flight.reset(seed)
        self._info = row(instant.infos, 0, 0)
        return instant.observation[0, 0], self._info

    def step(self, action: Any) -> tuple[Array, SupportsFloat, bool, bool, dict[str, Any]]:
        instant, _ = self.flight.step(actions_in(self.action_space, "action", action)[None, None])
        self._info = row(instant.infos, 0, 0)
        ends = bool(instant.terminated[0]), bool(instant.truncated[0])
        return instant.observation[0, 0], float(instant.reward[0, 0]), *ends, self._info

    def render(self) -> Any:
        return self.flight.render()

    def action_masks(self) -> Array:
        """Which actions are legal now, [A] bool; all of them if nothing is masked.

        Raises:
            AttributeError: actions are continuous.
        """
        if not isinstance(self.action_space, gymnasium.spaces.Discrete):
            raise AttributeError("action_masks: continuous actions have no mask")
        return self._info.get("action_mask", np.ones(self.action_space.n)).astype(bool)
