"""Settings of what the server computes: observations, rewards, and the ends of episodes."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from damian.common import checks
from damian.settings.fields import Settings, constant, setting

LOCAL_FEATURES = ["battery", "spotted"]
"""Features of the UAV itself."""
GLOBAL_FEATURES = [
    "source_distance",
    "source_bearing",
    "source_drift",
    "source_time",
    "agent_distances",
    "coverage",
    "mean_distance",
    "mean_distance_not_spotting",
    "mean_distance_spotting",
    "spotting_agents",
]
"""Features of all UAVs, in the order of the paper's Table 2."""
BELIEF_FEATURES = ["belief_gain", "belief_moments", "belief_map"]
"""Features of the belief."""
INDIVIDUAL = ("coverage", "spotted", "battery")
"""Terms of the individual reward (eq. 7)."""
SYSTEM = (
    "source_distance",
    "source_time",
    "source_bearing",
    "source_drift",
    "spotting_agents",
    "mean_distance",
    "mean_distance_not_spotting",
    "mean_distance_spotting",
)
"""Terms of the system reward (eq. 6)."""


@dataclass
class ObservationConfig(Settings):
    """Which features the actor and the critic observe."""

    section: ClassVar[str] = "observation"

    local_features: list[str] = setting(
        ["spotted"],
        "Features of the UAV itself: battery, spotted, or ``package.module:feature`` of your own.",
        choices=LOCAL_FEATURES,
        paths=True,
    )
    global_features: list[str] = setting(
        ["source_distance", "source_bearing", "source_time"],
        "Features that the server computes from the messages of all UAVs (Table 2): source_distance, "
        "source_bearing, source_drift, source_time, agent_distances, coverage, mean_distance, "
        "mean_distance_not_spotting, mean_distance_spotting, spotting_agents, or your own.",
        choices=GLOBAL_FEATURES,
        paths=True,
    )
    ctde: bool = setting(
        False,
        "Centralised training, decentralised execution: the actor observes only the local features.",
    )
    time_scale: float | None = setting(
        None,
        "Times are divided by this [s]; if not given, by the episode's time limit, or else by an hour.",
        above=0,
        unit="s",
    )
    age: bool = setting(
        False,
        "Append to each actor's observation the age of the message that the server holds of its UAV (age "
        "of information). The critic does not observe it: after back-updating, the age would tell the "
        "critic how far a step is from the end of its batch.",
    )
    age_scale: float = constant(
        10.0, "Ages are divided by this [s]. A policy scales it by its first layer.", above=0, unit="s"
    )
    own: bool = setting(
        False,
        "Each UAV observes its own latest message without delay. If false, as in the paper, its whole "
        "observation follows from the messages that the server holds, its own included.",
    )
    estimate: str = setting(
        "mean",
        "How the server estimates the source's position. ``mean``: the mean position of all UAVs' latest "
        "detections. ``newest``: the mean of only the newest of these, as a moving source has left the "
        "older ones.",
        choices=("mean", "newest"),
    )
    belief: list[str] = setting(
        [],
        "Features of where the source is, by Bayes' rule from all messages that have arrived, appended to "
        "what actor and critic observe: belief_gain (for each discrete action, the probability that it "
        "leads to where the source is detected), belief_moments, belief_map, or "
        "``package.module:feature`` of your own.",
        choices=BELIEF_FEATURES,
        paths=True,
    )
    belief_cell: float | None = setting(
        None,
        "Edge of a cell of the belief [m]; if not given, 0.8 footprint radii, or more in large regions.",
        above=0,
        unit="m",
    )
    window: int = setting(
        2, "Number of each UAV's latest landing points whose footprints the coverage counts.", low=1, high=16
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("local_features", "global_features", "belief"):
            checks.distinct(f"observation.{name}", getattr(self, name))
        blind = "actor" if not self.actor else "critic"  # which does not observe ages
        problem, sees = f"leaves the {blind} blind", bool(self.critic and self.actor)
        checks.require(sees, "observation.local_features", self.local_features, problem)

    @property
    def actor(self) -> list[str]:
        """Features of the actor's observation, in order."""
        features = [*self.local_features, *self.belief] if self.ctde else self.critic
        return [*features, "age"] if self.age else features

    @property
    def critic(self) -> list[str]:
        """Features of the critic's observation, in order."""
        return [*self.global_features, *self.local_features, *self.belief]


@dataclass
class RewardConfig(Settings):
    """The task, as weights of the reward terms (eq. 5-8). A term with weight 0 is not computed."""

    section: ClassVar[str] = "reward"

    coverage: float = setting(
        0.0,
        "Weight of the share of the UAV's latest footprints that is new, in the region and in no other "
        "UAV's footprint (w_ca of R1^a, eq. 7).",
        low=-1e6,
        high=1e6,
    )
    spotted: float = setting(
        1.0,
        "Weight of spotting the source, over the motions since the UAV last spotted it (w_k of R2^a, eq. 7).",
        low=-1e6,
        high=1e6,
    )
    battery: float = setting(
        0.0, "Weight of the battery level, in [0, 1] (w_b of R3^a, eq. 7).", low=-1e6, high=1e6
    )
    source_distance: float = setting(
        0.0,
        "Weight of being near the source, as estimated from detections, over the motions since the UAV "
        "last spotted it (w_ds of R1^s, eq. 6).",
        low=-1e6,
        high=1e6,
    )
    source_time: float = setting(
        0.0, "Weight of a recent detection by any UAV (w_ts of R2^s, eq. 6).", low=-1e6, high=1e6
    )
    source_bearing: float = setting(
        0.0,
        "Weight of a small bearing of the source, clockwise from north (w_bs of R3^s, eq. 6).",
        low=-1e6,
        high=1e6,
    )
    source_drift: float = setting(
        0.0,
        "Weight of a heading towards the source (w_th of R4^s, eq. 6); ``drift`` says how it is paid.",
        low=-1e6,
        high=1e6,
    )
    spotting_agents: float = setting(
        0.0,
        "Weight of a share of spotting UAVs near ``desired_spotting`` (w_ss of R5^s, eq. 6).",
        low=-1e6,
        high=1e6,
    )
    mean_distance: float = setting(
        0.0,
        "Weight of a mean distance to the other UAVs near ``desired_distance`` (w_avg of R6^s, eq. 6).",
        low=-1e6,
        high=1e6,
    )
    mean_distance_not_spotting: float = setting(
        0.0,
        "Weight of a mean distance between UAVs that do not spot near ``desired_distance_not_spotting`` "
        "(w_nss of R7^s, eq. 6).",
        low=-1e6,
        high=1e6,
    )
    mean_distance_spotting: float = setting(
        0.0,
        "Weight of a mean distance of the spotting UAVs to the source near ``desired_distance_spotting`` "
        "(w_ss of R8^s, eq. 6).",
        low=-1e6,
        high=1e6,
    )
    individual: float = constant(
        1.0,
        "Weight of the individual reward, the terms coverage, spotted and battery (w_a, eq. 8). The "
        "weights of the terms scale the same.",
        low=-1e6,
        high=1e6,
    )
    system: float = constant(
        1.0,
        "Weight of the system reward, the terms from source_distance to mean_distance_spotting (w_s, eq. "
        "8). The weights of the terms scale the same.",
        low=-1e6,
        high=1e6,
    )
    drift: str = setting(
        "smooth",
        "R4^s for a drift theta. ``smooth``: 1 - |2 theta - 1|; ``printed``: 2 theta up to 1/2, then 1 - "
        "theta, as eq. 6 is printed.",
        choices=("smooth", "printed"),
    )
    desired_spotting: float = setting(
        1.0, "M_ss of R5^s: desired share of the UAVs that spot the source.", low=0, high=1
    )
    desired_distance: float = setting(
        0.5,
        "D of R6^s: desired mean distance, as a share of the region's largest vertex distance.",
        low=0,
        high=2,
    )
    desired_distance_not_spotting: float = setting(
        0.5,
        "D_nss of R7^s: desired mean distance between UAVs that do not spot, as such a share.",
        low=0,
        high=2,
    )
    desired_distance_spotting: float = setting(
        0.1,
        "D_ss of R8^s: desired mean distance of the spotting UAVs to the source, as such a share.",
        low=0,
        high=2,
    )
    bonus: float = setting(0.0, "Added to the reward of every UAV on success.", low=-1e6, high=1e6)
    bonus_over_steps: bool = setting(
        False,
        "Divide the bonus by the elapsed steps of the episode (use case 2: 2 / steps).",
    )
    penalty: float = setting(
        0.0,
        "Subtracted from the reward of every UAV when an episode ends without success.",
        low=-1e6,
        high=1e6,
    )
    custom: list[Any] = setting(
        [],
        "Terms of your own (``damian.reward_term``), each as ``{term: package.module:name, weight: "
        "0.1}`` with any parameters of the term beside its weight, and a ``name`` if a term appears "
        "twice.",
    )

    @property
    def terms(self) -> list[str]:
        """Names of the terms whose weight is not 0, the user's own last."""
        individual = [name for name in INDIVIDUAL if getattr(self, name) * self.individual != 0]
        system = [name for name in SYSTEM if getattr(self, name) * self.system != 0]
        return [*individual, *system, *(name for name, weight in self._own_weights() if weight != 0)]

    def _own_weights(self) -> list[tuple[str, Any]]:
        """Names and weights of the user's own terms, as they are written."""
        written = [each for each in self.custom if isinstance(each, Mapping)]
        named = [(each.get("name") or str(each.get("term")).rpartition(":")[2], each) for each in written]
        return [(name, each.get("weight", 1.0)) for name, each in named]


@dataclass
class EpisodeConfig(Settings):
    """Conditions that end an episode (paper, section 4.1). Without any of them the task never ends."""

    section: ClassVar[str] = "episode"

    max_steps: int | None = setting(
        50, "Time limit [steps]; no limit if not given.", low=1, high=checks.STEPS
    )
    since_detection: bool = setting(
        False,
        "Count the time limit from the latest detection instead of from the start of the episode.",
    )
    success_share: float | None = setting(
        None,
        "Share of the UAVs that must spot the source at the same time for success; if not given, no success.",
        above=0,
        high=1,
    )
    discharged_share: float | None = setting(
        None,
        "Share of the UAVs whose empty batteries end the episode; if not given, batteries never end it. A "
        "battery is empty if its observed level is 0, or if it allows nothing but holding.",
        above=0,
        high=1,
    )
    end_with_source: bool = setting(
        False,
        "End the episode when the source has finished its walk and stops for good (``source.after_walk``).",
    )
