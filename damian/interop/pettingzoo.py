"""PettingZoo: an environment of several UAVs, and a wrapper that delays any environment."""

from typing import Any

import numpy as np
from gymnasium.spaces import Space

from damian.common.errors import InputError
from damian.envs.config import ScenarioConfig
from damian.interop.delay_wrapper import ByName, Delays
from damian.interop.flight import METADATA, Array, Flight, actions_in, row

try:
    from pettingzoo import ParallelEnv
    from pettingzoo.utils import BaseParallelWrapper
except ImportError as error:
    raise InputError("pettingzoo: it is not installed; pip install pettingzoo") from error


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


class DelayParallelWrapper(BaseParallelWrapper[str, Any, Any]):
    """Delays what the agents of any ``ParallelEnv`` observe, do and earn, each as ``DelayWrapper``
    does.

    An agent may leave the episode, with all its rewards, or join it (again), with an observation
    that is not late and nothing of its former life.
    ``state()`` is not late.

    Args:
        env, history, timeline, dt: as in ``DelayWrapper``.
        observation, action, reward, loss: a law for all agents, or by agent; those not named are
            not late. A function knows the agent as ``message.sender``, its place among
            ``possible_agents``.
        default: the action that is executed until the first one arrives, by agent; if not given, 0.
    """

    def __init__(
        self,
        env: ParallelEnv[str, Any, Any],
        observation: Any = 0,
        action: Any = 0,
        reward: Any = 0,
        *,
        loss: Any = 0.0,
        history: int = 0,
        timeline: int = 0,
        default: ByName | None = None,
        dt: float = 1.0,
    ) -> None:
        super().__init__(env)
        told = {
            "observation": observation,
            "action": action,
            "reward": reward,
            "loss": loss,
            "history": history,
            "timeline": timeline,
            "default": default or {},
            "dt": dt,
        }
        observed = {agent: env.observation_space(agent) for agent in env.possible_agents}
        self._delays = Delays(
            observed, {agent: env.action_space(agent) for agent in observed}, told
        )
        self._spaces = {
            agent: self._delays.space(agent, space) for agent, space in observed.items()
        }

    def observation_space(self, agent: str) -> Space:
        return self._spaces[agent]

    def reset(
        self, seed: int | None = None, options: ByName | None = None
    ) -> tuple[ByName, ByName]:
        observations, infos = self.env.reset(seed=seed, options=options)
        told, more = self._delays.reset(observations, seed)
        return told, {agent: infos.get(agent, {}) | info for agent, info in more.items()}

    def step(self, actions: ByName) -> tuple[ByName, ByName, ByName, ByName, ByName]:
        observations, rewards, terminated, truncated, infos = self.env.step(
            self._delays.act(actions)
        )
        ended = [agent for agent in rewards if terminated[agent] or truncated[agent]]
        ended += self._delays.present.difference(
            self.env.agents, ended
        )  # some leave without a flag
        told, rewards, more = self._delays.step(observations, rewards, ended)
        return (
            told,
            rewards,
            terminated,
            truncated,
            {a: infos.get(a, {}) | info for a, info in more.items()},
        )
