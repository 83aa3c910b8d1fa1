"""All settings of an environment."""

from dataclasses import dataclass

from damian.settings.delays import ClockConfig, DelayConfig, LinkConfig
from damian.settings.fields import setting
from damian.settings.server import EpisodeConfig, ObservationConfig, RewardConfig
from damian.settings.world import WorldConfig


@dataclass
class ScenarioConfig(WorldConfig):
    """Settings of a whole scenario, as in ``make_env(ScenarioConfig(agents=5), num_worlds=64)``."""

    observation: ObservationConfig = setting(ObservationConfig)
    reward: RewardConfig = setting(RewardConfig)
    episode: EpisodeConfig = setting(EpisodeConfig)
    clock: ClockConfig = setting(ClockConfig)
    delay: DelayConfig = setting(DelayConfig)
    links: LinkConfig = setting(LinkConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.links.check(self.agents)
        links, observation, episode = self.links.kind, self.observation, self.episode
        problem = "does not go with clock.server: between two broadcasts no observation changes"
        self.refuse(observation.own and self.clock.steps("server") > 1, "observation.own", problem)
        problem = "does not go with links=updown: the server has computed what a UAV receives"
        self.refuse(observation.own and links == "updown", "observation.own", problem)
        problem = "does not go with links=matrix: no UAV computes a belief from what it hears directly"
        self.refuse(observation.belief and links == "matrix", "observation.belief", problem)
        per_action = "belief_gain" in observation.belief
        problem = "needs discrete actions: it has a value for each of them"
        self.refuse(per_action and self.actions.kind == "continuous", "observation.belief", problem)
        problem = "is empty for a single UAV: add another feature"
        empty = self.agents == 1 and observation.critic == ["agent_distances"]
        self.refuse(empty, "observation.global_features", problem)
        problem = f"does not go with links={links}: a UAV would get the messages that the server has received"
        self.refuse(self.delay.messages and links != "server", "delay.messages", problem)
        problem = "does not go with delay.order=arrival: a slot would change with when a message arrived"
        self.refuse(observation.timeline and self.delay.order == "arrival", "observation.timeline", problem)
        never = episode.discharged_share is not None and not self.battery.enabled
        self.refuse(never, "episode.discharged_share", "needs battery.enabled=true")
        stops = self.source.motion == "dynamic" and self.source.after_walk == "stop"
        problem = "needs source.motion=dynamic and source.after_walk=stop"
        self.refuse(episode.end_with_source and not stops, "episode.end_with_source", problem)

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
