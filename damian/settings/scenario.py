"""All settings of an environment."""

from dataclasses import dataclass, field

from damian.common import checks
from damian.settings.delays import ClockConfig, DelayConfig, LinkConfig
from damian.settings.server import EpisodeConfig, ObservationConfig, RewardConfig
from damian.settings.world import WorldConfig


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
        self.links.check(self.agents)
        self._check_ends()
        conflict = self.observation.own and self.clock.steps("server") > 1
        problem = "does not go with clock.server: between two broadcasts no observation changes"
        checks.require(not conflict, "observation.own", True, problem)
        conflict = self.observation.own and self.links.kind == "updown"
        problem = "does not go with links=updown: the server has computed what a UAV receives"
        checks.require(not conflict, "observation.own", True, problem)
        self._check_belief()
        messages, links = self.delay.messages, self.links.kind
        problem = f"does not go with links={links}: a UAV would get the messages that the server has received"
        checks.require(not messages or links == "server", "delay.messages", messages, problem)
        empty = self.agents == 1 and self.observation.critic == ["agent_distances"]
        problem = "is empty for a single UAV: add another feature"
        checks.require(not empty, "observation", "agent_distances", problem)

    def _check_belief(self) -> None:
        """Refuse beliefs that nothing computes."""
        belief = self.observation.belief
        problem = "does not go with links=matrix: no UAV computes a belief from what it hears directly"
        checks.require(not (belief and self.links.kind == "matrix"), "observation.belief", belief, problem)
        problem = "needs discrete actions: it has a value for each of them"
        continuous = self.actions.kind == "continuous"
        checks.require(not (continuous and "belief_gain" in belief), "observation.belief", belief, problem)

    def _check_ends(self) -> None:
        """Refuse end conditions of an episode that can never be met (paper, section 4.1)."""
        checks.require(
            self.episode.discharged_share is None or self.battery.enabled,
            "episode.discharged_share",
            self.episode.discharged_share,
            "needs battery.enabled=true: the batteries stay full",
        )
        stops = self.source.motion == "dynamic" and self.source.after_walk == "stop"
        checks.require(
            not self.episode.end_with_source or stops,
            "episode.end_with_source",
            True,
            "needs source.motion=dynamic and source.after_walk=stop: another source never ends its walk",
        )

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
