"""All settings of an environment, and the simulation and server node that are built from them."""

from dataclasses import dataclass, field

from damian.common import checks
from damian.delays.config import DelayConfig, LinkConfig
from damian.envs.clocks import ClockConfig
from damian.server.features import ObservationConfig
from damian.server.rewards import RewardConfig
from damian.server.server import Server
from damian.server.termination import EpisodeConfig
from damian.world.config import WorldConfig
from damian.world.simulation import Simulation


@dataclass
class ScenarioConfig(WorldConfig):
    """Settings of a whole scenario, as in ``make_env(ScenarioConfig(agents=5), num_worlds=64)``."""

    observation: ObservationConfig = field(default_factory=ObservationConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    episode: EpisodeConfig = field(default_factory=EpisodeConfig)
    clock: ClockConfig = field(default_factory=ClockConfig)
    delay: DelayConfig = field(default_factory=DelayConfig)
    links: LinkConfig = field(default_factory=LinkConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.delay.check(self.clock.dt)
        self.links.check(self.agents)
        own, belief, links = self.observation.own, self.observation.belief, self.links.kind
        problem = "does not go with clock.server: between two broadcasts no observation changes"
        checks.require(not own or self.clock.steps("server") == 1, "observation.own", True, problem)
        problem = "does not go with links=updown: the server has computed what a UAV receives"
        checks.require(not own or links != "updown", "observation.own", True, problem)
        problem = "does not go with links=matrix: no UAV computes a belief from what it hears directly"
        checks.require(not belief or links != "matrix", "observation.belief", belief, problem)
        problem = "needs discrete actions: it has a value for each of them"
        fits = "belief_gain" not in belief or self.actions.kind == "discrete"
        checks.require(fits, "observation.belief", belief, problem)
        messages = self.delay.messages
        problem = f"does not go with links={links}: a UAV would get the messages that the server has received"
        checks.require(not messages or links == "server", "delay.messages", messages, problem)
        empty = self.agents == 1 and self.observation.critic == ["agent_distances"]
        problem = "is empty for a single UAV: add another feature"
        checks.require(not empty, "observation", "agent_distances", problem)
        # Ends of an episode that can never be met (paper, section 4.1).
        share = self.episode.discharged_share
        problem = "needs battery.enabled=true: the batteries stay full"
        checks.require(share is None or self.battery.enabled, "episode.discharged_share", share, problem)
        stops = self.source.motion == "dynamic" and self.source.after_walk == "stop"
        problem = "needs source.motion=dynamic and source.after_walk=stop: another source never ends its walk"
        checks.require(not self.episode.end_with_source or stops, "episode.end_with_source", True, problem)

    @property
    def seeks_source(self) -> bool:
        """Whether anything is won by finding the source."""
        terms = {*self.reward.terms} - {"coverage", "battery", "mean_distance"}
        return bool(terms) or self.episode.success_share is not None

    @property
    def time_scale(self) -> float:
        """Time by which time features are divided [s]: the setting, else the time limit, else one hour."""
        limit = None if self.episode.max_steps is None else self.episode.max_steps * self.clock.dt
        return self.observation.time_scale or limit or 3600.0


def make_simulation(scenario: ScenarioConfig, seed: int) -> Simulation:
    """Build the physics of a scenario.

    Args:
        scenario: all settings.
        seed: of the regions, the start positions and the source's walks; at least 0.

    Raises:
        InputError: the scenario asks for something impossible, or the seed is no whole number.
    """
    checks.seed("seed", seed, 0)
    return Simulation(scenario, scenario.clock.dt, scenario.observation.window, seed)


def make_server(scenario: ScenarioConfig, simulation: Simulation) -> Server:
    """Build the server node of a scenario for the regions of a simulation.

    Raises:
        InputError: there are more landing points than a message can number.
    """
    return Server(
        scenario.observation,
        scenario.reward,
        scenario.episode,
        scenario.battery,
        simulation.airspace,
        radius=simulation.radius,
        dt=scenario.clock.dt,
        time_scale=scenario.time_scale,
        readings={name: sensor.width for name, sensor in simulation.sensors.items()},
        stops=not simulation.vehicles.instant,
        source=scenario.source,
        goals=simulation.candidates.goals() if "belief_gain" in scenario.observation.belief else None,
    )
