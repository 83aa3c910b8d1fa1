"""Gymnasium environments of one UAV: a single world, and many worlds that step as one batch."""

from typing import Any, SupportsFloat, cast

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from damian.common import checks
from damian.envs.config import ScenarioConfig
from damian.interop.flight import METADATA, Array, Flight, Infos, actions_in, row


class UavGymEnv(gymnasium.Env[Array, Any]):
    """One UAV of a scenario, with its delays, as a Gymnasium environment.

    Observations are float32 [F], rewards those that the server perceives; ``info`` has ``ready``
    (may the UAV choose an action now; if not, its action changes nothing), ``is_success``, and, if
    actions are masked, ``action_mask`` [A] int8, as ``action_space.sample`` takes it.
    ``action_masks()`` is for sb3-contrib.

    Args:
        scenario: all settings, with ``agents=1``.
        seed: of the regions and initial conditions that are drawn now; ``reset(seed=...)`` decides
            the rest.
        render_mode: ``rgb_array``, or None.
    """

    metadata = METADATA

    def __init__(
        self,
        scenario: ScenarioConfig,
        seed: int = 0,
        render_mode: str | None = None,
    ) -> None:
        one_uav(scenario)
        self.flight = Flight(scenario, 1, seed, render_mode)
        self.render_mode = render_mode
        self.observation_space = self.flight.observation_space(0)
        self.action_space = self.flight.action_space()
        self._infos: dict[str, Array] = {}

    def reset(
        self, *, seed: int | None = None, options: Infos | None = None
    ) -> tuple[Array, Infos]:
        super().reset(seed=seed)
        instant = self.flight.reset(seed)
        self._infos = instant.infos
        return instant.observation[0, 0], row(instant.infos, 0, 0)

    def step(self, action: Any) -> tuple[Array, SupportsFloat, bool, bool, Infos]:
        chosen = actions_in(self.action_space, "action", action)
        instant, _ = self.flight.step(chosen[None, None])
        self._infos = instant.infos
        info = row(instant.infos, 0, 0)
        reward = float(instant.reward[0, 0])
        terminated = bool(instant.terminated[0])
        truncated = bool(instant.truncated[0])
        return instant.observation[0, 0], reward, terminated, truncated, info

    def render(self) -> Any:
        return self.flight.render()

    def action_masks(self) -> Array:
        """Which discrete actions are legal now, [A] bool; all of them if nothing is masked."""
        space = cast(gymnasium.spaces.Discrete, self.action_space)
        info = row(self._infos, 0, 0)
        return info.get("action_mask", np.ones(space.n)).astype(bool)


class UavVectorEnv(gymnasium.vector.VectorEnv[Array, Any, Array]):
    """B = ``num_envs`` worlds of one UAV as a Gymnasium vector environment.

    A world whose episode ends begins a new one in the same step (``AutoresetMode.SAME_STEP``);
    ``infos`` then has its last observation as ``final_obs``, and its last infos as ``final_info``.
    World number i equals a ``UavGymEnv`` that is reset with ``seed + i``.
    """

    def __init__(self, scenario: ScenarioConfig, num_envs: int = 1, seed: int = 0) -> None:
        one_uav(scenario)
        checks.in_range("num_envs", num_envs, 1, checks.WORLDS)
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.num_envs = num_envs
        self.flight = Flight(scenario, num_envs, seed)
        self.single_observation_space = self.flight.observation_space(0)
        self.single_action_space = self.flight.action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: Infos | None = None
    ) -> tuple[Array, Infos]:
        is_list = isinstance(seed, list)
        checks.require(not is_list, "seed", seed, "is a list: world i draws from seed + i")
        instant = self.flight.reset(seed)  # type: ignore[arg-type]
        return instant.observation[:, 0], _infos(instant.infos)

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, Infos]:
        chosen = actions_in(self.action_space, "actions", actions)
        last, instant = self.flight.step(chosen[:, None], reset=True)
        infos = _infos(instant.infos)
        done = last.terminated | last.truncated
        if done.any():
            final = np.full(self.num_envs, None, object)
            for world in done.nonzero()[0]:
                final[world] = last.observation[world, 0]
            infos |= {"final_obs": final, "_final_obs": done}
            infos["final_info"] = _infos(last.infos, done)
            infos["_final_info"] = done
        observation = instant.observation[:, 0]
        reward = last.reward[:, 0]
        return observation, reward, last.terminated, last.truncated, infos


def _infos(infos: dict[str, Array], worlds: Array | None = None) -> Infos:
    """Infos of the worlds [B, ...] by name, each with a mask of the worlds [B] that have it
    (all)."""
    if worlds is None:
        worlds = np.ones(len(infos["ready"]), bool)
    found = {name: each if name == "is_success" else each[:, 0] for name, each in infos.items()}
    masks = {f"_{name}": worlds.copy() for name in found}
    return found | masks


def one_uav(scenario: ScenarioConfig) -> None:
    """Refuse a scenario of several UAVs, because a Gymnasium environment has one agent."""
    checks.require(
        scenario.agents == 1,
        "agents",
        scenario.agents,
        "is not 1: a Gymnasium environment has one agent; take "
        "damian.interop.pettingzoo.UavParallelEnv",
    )
