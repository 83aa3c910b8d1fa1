"""Settings of what the server computes: observations, rewards, and the ends of episodes."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from damian.common import checks
from damian.common.fields import Settings, constant, setting

EVENTS = "events"
"""The feature for which messages tell what happened at each stop."""
PENDING = "pending"
"""The feature that shows a UAV its own latest commands."""


@dataclass
class ObservationConfig(Settings):
    """Which features the actor and the critic observe, by name; your own as
    ``package.module:feature``.

    The last ones, from ``place`` and ``others`` on, go beyond the paper's Table 2.
    """

    section = "observation"

    local_features: list[str] = setting(
        ["spotted"],
        "Features of the UAV itself: battery, spotted, served, place, number, kind, pending.",
    )
    global_features: list[str] = setting(
        ["source_distance", "source_bearing", "source_time"],
        "Features from the messages of all UAVs: source_distance, source_bearing, source_drift, "
        "source_time, agent_distances, coverage, mean_distance, mean_distance_not_spotting, "
        "mean_distance_spotting, spotting_agents, others, ages, coverage_map, requests, "
        "detections, stops, events.",
    )
    ctde: bool = setting(False, "Whether the actor observes only the local features.")
    time_scale: float | None = setting(
        None,
        "Divides times; the time limit of episodes, or else an hour, if not given.",
        unit="s",
        above=0,
    )
    age: bool = setting(
        False, "Whether each actor observes the age of its UAV's message on the server."
    )
    age_scale: float = constant(
        10.0, "Divides ages; a policy's first layer scales them.", unit="s", above=0
    )
    own: bool = setting(
        False,
        "Whether each UAV knows its own messages at once, not when the server has them, as in the "
        "paper.",
    )
    intent: bool = setting(
        False,
        "Whether messages also tell where the commands under way will take their UAV, and by when; "
        "each actor observes this of the nearest others.",
    )
    actions: bool = setting(
        False,
        "Whether each actor observes what each discrete action offers: where it leads, the ground, "
        "sources and requests there.",
    )
    advice: bool = setting(
        True,
        "Whether ``actions`` also tells what the script makes of them: new ground in turn, gain and "
        "choice.",
    )
    detections: int = setting(
        3, "Number of newest detections of each source that ``detections`` tells.", low=1, high=16
    )
    belief: list[str] = setting(
        [],
        "Where the source is, by Bayes' rule: belief_gain (per action), belief_moments, belief_map.",
    )
    window: int = setting(
        2, "Latest landing points of a UAV that its coverage counts.", low=1, high=16
    )
    timeline: int = setting(
        0,
        "Number of latest steps: actor and critic observe where other UAVs were in each.",
        low=0,
        high=100,
    )
    stops: int | None = setting(
        None,
        "Latest landing points of a UAV, with their times, that its messages carry; if not given, "
        "as many as "
        "``window``, or as ``timeline`` has steps.",
        low=1,
        high=100,
    )

    forward: str | None = setting(
        None,
        "What late messages are flown forward by: by the script, or by the policy itself, which "
        "everybody is then assumed to follow.",
        choices=("script", "policy"),
    )
    forward_steps: int = setting(
        20, "Most steps that are flown forward.", unit="steps", low=1, high=100
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("local_features", "global_features", "belief"):
            checks.distinct(f"observation.{name}", getattr(self, name))
        fewer = self.stops is not None and self.stops < self.window
        self.refuse(
            fewer, "stops", f"is fewer than observation.window={self.window}, which coverage counts"
        )
        self.refuse(not self.actor, "local_features", "leaves the actor blind")
        self.refuse(
            not self.critic, "local_features", "leaves the critic blind"
        )  # it observes no ages

    @property
    def actor(self) -> list[str]:
        """Features of the actor's observation, in order."""
        features = [*self.local_features, *self.belief, *self.timed] if self.ctde else self.critic
        told = [*["age"] * self.age, *["announced"] * self.intent, *["actions"] * self.actions]
        return [*features, *told]

    @property
    def critic(self) -> list[str]:
        """Features of the critic's observation, in order.

        It has no age: after back-updating, that would tell how far a step is from the end of its
        batch.
        """
        return [*self.global_features, *self.local_features, *self.belief, *self.timed]

    @property
    def timed(self) -> list[str]:
        """The feature of other UAVs by time, if it is observed."""
        return ["timeline"] * (self.timeline > 0)

    @property
    def carried_stops(self) -> int:
        """Number of latest stops of a UAV that its messages carry."""
        return max(self.window, self.timeline) if self.stops is None else self.stops


@dataclass
class RewardWeights(Settings):
    """The weights of the built-in reward terms (eq. 6 and 7). A term with weight 0 is not
    computed."""

    coverage: float = setting(
        0.0, "Weight of newly covered area that no other UAV covers (R1^a, eq. 7)."
    )
    spotted: float = setting(
        1.0, "Weight of spotting the source, over the motions since (R2^a, eq. 7)."
    )
    battery: float = setting(0.0, "Weight of the battery level (R3^a, eq. 7).")
    served: float = setting(0.0, "Weight of serving a request.")
    source_distance: float = setting(
        0.0, "Weight of being near the source, over the motions since it was spotted (R1^s, eq. 6)."
    )
    source_time: float = setting(0.0, "Weight of a recent detection by any UAV (R2^s, eq. 6).")
    source_bearing: float = setting(0.0, "Weight of a small bearing of the source (R3^s, eq. 6).")
    source_drift: float = setting(0.0, "Weight of a heading towards the source (R4^s, eq. 6).")
    spotting_agents: float = setting(
        0.0, "Weight of spotting by the desired share of UAVs (R5^s, eq. 6)."
    )
    mean_distance: float = setting(
        0.0, "Weight of a mean distance as desired between UAVs (R6^s, eq. 6)."
    )
    mean_distance_not_spotting: float = setting(
        0.0, "The same between UAVs that do not spot (R7^s, eq. 6)."
    )
    mean_distance_spotting: float = setting(
        0.0, "The same from spotting UAVs to the source (R8^s, eq. 6)."
    )


BUILT_IN = tuple(each.name for each in fields(RewardWeights))
"""Names of the built-in reward terms."""


@dataclass
class RewardConfig(RewardWeights):
    """The task: weights and parameters of the reward terms, bonus and penalty (eq. 5-8)."""

    section = "reward"

    individual: float = constant(1.0, "w_a of eq. 8; the weights of the terms scale the same.")
    system: float = constant(1.0, "w_s of eq. 8; the weights of the terms scale the same.")
    drift: str = setting(
        "smooth",
        "R4^s of a drift d: 1 - |2 d - 1| (smooth), or as printed: 2 d up to 1/2, then 1 - d.",
        choices=("smooth", "printed"),
    )
    desired_spotting: float = setting(
        1.0, "M_ss of R5^s: desired share of the UAVs.", low=0, high=1
    )
    desired_distance: float = setting(
        0.5, "D of R6^s, in largest distances between vertices.", low=0, high=2
    )
    desired_distance_not_spotting: float = setting(
        0.5, "D_nss of R7^s, in the same unit.", low=0, high=2
    )
    desired_distance_spotting: float = setting(
        0.1, "D_ss of R8^s, in the same unit.", low=0, high=2
    )
    detection: str = setting(
        "reports",
        "What counts as spotting: what UAVs report, or the truth, which only a simulator knows; "
        "with misses "
        "and false alarms they differ.",
        choices=("reports", "truth"),
    )
    bonus: float = setting(0.0, "Added to the reward of every UAV on success.")
    bonus_over_steps: bool = setting(False, "Divide the bonus by the elapsed steps of the episode.")
    penalty: float = setting(
        0.0, "Subtracted from every reward when an episode ends without success."
    )
    custom: list[Any] = setting(
        [],
        "Terms of your own: {term: package.module:name, weight: 0.1, parameter: ..., name: ...}.",
    )

    @property
    def terms(self) -> list[str]:
        """Names of the terms whose weight is not 0, the user's own last."""
        own = [
            each
            for each in self.custom
            if isinstance(each, Mapping) and each.get("weight", 1.0) != 0
        ]
        names = [each.get("name") or str(each.get("term")).rpartition(":")[2] for each in own]
        return [*(name for name in BUILT_IN if getattr(self, name) != 0), *names]


@dataclass
class EpisodeConfig(Settings):
    """Conditions that end an episode (paper, section 4.1). Without any of them the task never
    ends."""

    section = "episode"

    max_steps: int | None = setting(
        50, "Time limit; none if not given.", unit="steps", low=1, high=checks.STEPS
    )
    since_detection: bool = setting(False, "Count the time limit from the latest detection.")
    success_share: float | None = setting(
        None,
        "Share of the UAVs that must spot at once for success; none if not given.",
        above=0,
        high=1,
    )
    discharged_share: float | None = setting(
        None,
        "Share of the UAVs whose empty batteries end the episode; none if not given.",
        above=0,
        high=1,
    )
    end_with_source: bool = setting(False, "End the episode when the source has stopped for good.")
    all_sources: bool = setting(
        False, "Success when each source is spotted, by any UAV, at the same time."
    )

    @property
    def can_succeed(self) -> bool:
        """Whether an episode can end with success."""
        return self.success_share is not None or self.all_sources
