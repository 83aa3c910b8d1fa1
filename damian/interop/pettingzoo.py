"""An environment of several UAVs for PettingZoo."""

from typing import Any

import numpy as np
from gymnasium.spaces import Space

from damian.common.errors import InputError
from damian.envs.config import ScenarioConfig
from damian.interop.flight import METADATA, Array, Flight, actions_in, row

try:
    from pettingzoo import ParallelEnv
except ImportError as error:
    raise InputError("pettingzoo: it is not installed; pip install pettingzoo") from error

ByName = dict[str, Any]
"""Something of each agent."""


class UavParallelEnv(ParallelEnv[str, Array, Any]):
    """The UAVs of a scenario, with its delays, as a PettingZoo ``ParallelEnv``, from ``uav_0`` on.

    All episodes end together. Observations are float32 [F]; infos and arguments are those of
    ``UavGymEnv``. ``state()``: what the server observes of the messages that it holds, for a
    central critic.
    """

    def __init__(
        self,
        scenario: ScenarioConfig,
        seed: int = 0,
        render_mode: str | None = None,
    ) -> None:
        self.metadata = {**METADATA, "name": "damian_v0", "is_parallelizable": True}
        self.flight = Flight(scenario, 1, seed, render_mode)
        self.render_mode = render_mode
        self.possible_agents = [f"uav_{number}" for number in range(scenario.agents)]
        self.agents: list[str] = []
        self.observation_spaces = {
            name: self.flight.observation_space(i) for i, name in enumerate(self.possible_agents)
        }
        self.action_spaces = {name: self.flight.action_space() for name in self.possible_agents}
        self.state_space: Space = self.flight.state_space()

    def observation_space(self, agent: str) -> Space:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Space:
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: ByName | None = None
    ) -> tuple[ByName, ByName]:
        instant = self.flight.reset(seed)
        self.agents = [*self.possible_agents]
        return self._by_agent(instant.observation[0]), self._infos(instant.infos)

    def step(self, actions: ByName) -> tuple[ByName, ByName, ByName, ByName, ByName]:
        if not self.agents:
            return {}, {}, {}, {}, {}
        chosen = [
            actions_in(self.action_spaces[name], f"action of {name}", actions[name])
            for name in self.agents
        ]
        instant, _ = self.flight.step(np.stack(chosen)[None])
        n_agents = len(self.agents)
        infos = self._infos(instant.infos)
        terminated = bool(instant.terminated[0])
        truncated = bool(instant.truncated[0])
        results = (
            self._by_agent(instant.observation[0]),
            self._by_agent(instant.reward[0].tolist()),
            self._by_agent([terminated] * n_agents),
            self._by_agent([truncated] * n_agents),
        )
        if terminated or truncated:
            self.agents = []
        return *results, infos

    def render(self) -> Any:
        return self.flight.render()

    def state(self) -> Array:
        return self.flight.state()

    def _by_agent(self, values: Any) -> ByName:
        """Values [N] by agent."""
        return dict(zip(self.possible_agents, values, strict=True))

    def _infos(self, infos: dict[str, Array]) -> ByName:
        return {name: row(infos, 0, number) for number, name in enumerate(self.possible_agents)}
