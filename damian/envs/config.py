"""All settings of an environment, with those of its clocks."""

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from damian.common import checks
from damian.common.fields import Settings, setting
from damian.delays.config import DelayConfig, LinkConfig
from damian.server.config import (
    EVENTS,
    PENDING,
    EpisodeConfig,
    ObservationConfig,
    RewardConfig,
)
from damian.world.config import FOOTPRINT, WorldConfig

if TYPE_CHECKING:
    from damian.delays.scenario import ScenarioDelays


@dataclass
class ClockConfig(Settings):
    """Periods of the clocks, such as ``1s``, ``200ms`` or ``2min``, each a multiple of the faster
    ones."""

    section = "clock"

    simulation: str = setting("1s", "Length of a simulation step, ``dt``.")
    agents: str | None = setting(
        None, "Period at which an agent decides; ``simulation`` if not given."
    )
    server: str | None = setting(
        None, "Period at which the server broadcasts; ``simulation`` if not given."
    )
    system: str | None = setting(
        None, "Period of the learner's batches; from learner.steps if not given."
    )
    trigger: str | None = setting(
        None,
        "Change of that period at each tick: shorter if a UAV of half the worlds spots, else "
        "longer.",
    )
    shortest: str | None = setting(None, "Shortest triggered period; ``trigger`` if not given.")
    longest: str | None = setting(
        None, "Longest triggered period; twice the first one if not given."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        fast = ("simulation", "agents", "server")
        triggered = ("trigger", "shortest", "longest")
        for slower, faster in itertools.permutations((*fast, "system"), 2):
            if self._seconds(slower) >= self._seconds(faster) or faster == "simulation":
                self._check_multiple(slower, faster)
        given = [name for name in triggered if getattr(self, name) is not None]
        for name, faster in itertools.product(given, fast):
            self._check_multiple(name, faster)
        checks.in_range("clock.simulation", self.dt, 1e-3, 86_400, "s")  # a millisecond to a day
        for name in given:
            self.refuse(self.trigger is None, name, "means nothing without clock.trigger")

    def _check_multiple(self, slow: str, fast: str) -> None:
        ratio = self._seconds(slow) / self._seconds(fast)
        whole = math.isclose(ratio, max(round(ratio), 1), rel_tol=1e-9)
        checks.require(
            whole,
            f"clock.{slow}",
            self._period(slow),
            f"is not a multiple of clock.{fast}={self._period(fast)}",
        )

    def _period(self, name: str) -> str:
        return getattr(self, name) or self.simulation

    def _seconds(self, name: str) -> float:
        return checks.seconds(f"clock.{name}", self._period(name))

    @property
    def dt(self) -> float:
        """Length of a simulation step [s]."""
        return self._seconds("simulation")

    def steps(self, name: str) -> int:
        """Period of the clock of this name [simulation steps]."""
        return round(self._seconds(name) / self.dt)


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
        if "source.level_db" in self.randomise and FOOTPRINT not in self.sensors:
            self.sensors = [*self.sensors, FOOTPRINT]
        links = self.links.kind
        observation = self.observation
        episode = self.episode
        self.refuse(
            observation.own and self.clock.steps("server") > 1,
            "observation.own",
            "does not go with clock.server: between two broadcasts no observation changes",
        )
        self.refuse(
            observation.own and links == "updown",
            "observation.own",
            "does not go with links=updown: the server has computed what a UAV receives",
        )
        self.refuse(
            observation.belief and links == "matrix",
            "observation.belief",
            "does not go with links=matrix: no UAV computes a belief from what it hears directly",
        )
        drawn = {"source.miss", "source.false_alarm"} & {*self.randomise}
        self.refuse(
            observation.belief and drawn,
            "observation.belief",
            "does not go with randomise of source.miss or source.false_alarm, which the filter "
            "knows",
        )
        continuous = self.actions.kind == "continuous"
        per_action = {"belief": "belief_gain" in observation.belief, "actions": observation.actions}
        problem = "needs discrete actions: it has values for each of them"
        for name, observed in per_action.items():
            self.refuse(observed and continuous, f"observation.{name}", problem)
        problem = "is empty for a single UAV: add another feature"
        empty = self.agents == 1 and observation.critic == ["agent_distances"]
        self.refuse(empty, "observation.global_features", problem)
        self.refuse(
            self.delay.messages and links != "server",
            "delay.messages",
            f"does not go with links={links}: a UAV would get the messages that the server has "
            "received",
        )
        self.refuse(
            observation.timeline and self.delay.order == "arrival",
            "observation.timeline",
            "does not go with delay.order=arrival: a slot would change with when a message arrived",
        )
        asked = "requests" in observation.global_features or self.reward.served
        self.refuse(
            asked and not self.requests.slots, "requests.rate", "is 0, so that no request appears"
        )
        told = self.seeks_source or self.requests.slots
        wrong = self.tells_events and not (observation.timeline and told)
        self.refuse(
            wrong,
            "observation.global_features",
            f"has {EVENTS}, which need observation.timeline, and a source or requests that count",
        )
        never = episode.discharged_share is not None and not self.battery.enabled
        self.refuse(never, "episode.discharged_share", "needs battery.enabled=true")
        stops = self.source.motion == "dynamic" and self.source.after_walk == "stop"
        self.refuse(
            episode.end_with_source and not stops,
            "episode.end_with_source",
            "needs source.motion=dynamic and source.after_walk=stop",
        )
        self._check_commands()
        self._check_forward()

    def _check_commands(self) -> None:
        absolute = self.actions.command == "absolute"
        holds = self.actions.kind == "continuous" or 0.0 in self.actions.distances
        unknown = f"links={self.links.kind}: the server would not know what a UAV has sent"
        refused = {
            f"does not go with {unknown}": self.links.kind != "server",
            "does not go with clock.server: between two broadcasts no observation changes": (
                self.clock.steps("server") > 1
            ),
            "needs 0 among actions.distances: a UAV holds until its first command arrives": (
                not holds
            ),
        }
        for problem, wrong in refused.items():
            self.refuse(absolute and wrong, "actions.command", problem)
        problem = "needs actions.command=absolute and a delay of actions: nothing else is under way"
        wanted = {
            "observation.intent": self.observation.intent,
            "observation.local_features": PENDING in self.observation.local_features,
        }
        for key, asked in wanted.items():
            self.refuse(asked and not self.tells_commands, key, problem)

    def _check_forward(self) -> None:
        forward = self.observation.forward
        refused = {
            "needs observation.own=true: a UAV that flies forward knows what it did itself": (
                not self.observation.own
            ),
            "does not go with links=matrix: what UAVs hear directly is not flown forward": (
                self.links.kind == "matrix"
            ),
            "does not go with observation.belief: no belief is flown forward": bool(
                self.observation.belief
            ),
            "goes with actions.command=absolute if all commands are discrete and equally late "
            "(delay.act_hold=max), and motion=instant": forward and not self._frames_follow(),
            "=policy does not go with delay.history: the copies tell no past actions": (
                forward == "policy" and self.delay.history > 0
            ),
        }
        for problem, wrong in refused.items():
            self.refuse(forward and wrong, "observation.forward", problem)

    def _frames_follow(self) -> bool:
        """Whether where late commands lead can be flown forward."""
        simple = self.actions.kind == "discrete" and self.motion.kind == "instant"
        constant = simple and self.make_delays().act.constant_delay is not None
        return not self.tells_commands or constant

    def make_delays(self) -> "ScenarioDelays":
        """Resolve the laws of all delays to samplers, which reads the files of traces."""
        from damian.delays.scenario import ScenarioDelays  # noqa: PLC0415 (settings load without torch)

        return ScenarioDelays(self.delay, self.links, self.clock.dt, "delay.loss" in self.randomise)

    @property
    def tells_truth(self) -> bool:
        return self.reward.detection == "truth"

    @property
    def tells_events(self) -> bool:
        return EVENTS in self.observation.global_features

    @property
    def tells_commands(self) -> bool:
        return self.actions.command == "absolute" and self.make_delays().act.late

    @property
    def announced(self) -> int:
        longest = self.make_delays().act.longest if self.observation.intent else 0
        return min(longest, self.observation.carried_stops)

    @property
    def pending(self) -> int:
        return self.latest_commands if PENDING in self.observation.local_features else 0

    @property
    def latest_commands(self) -> int:
        """Number of a UAV's latest commands that it remembers."""
        delays = self.make_delays()
        # At most so many are under way, or have been executed since the message that is known.
        longest = delays.act.longest + (0 if self.observation.own else delays.obs.longest)
        return max(min(longest, self.observation.carried_stops), 1)

    @property
    def seeks_source(self) -> bool:
        terms = {*self.reward.terms} - {"coverage", "battery", "mean_distance", "served"}
        return bool(terms) or self.episode.can_succeed

    @property
    def time_scale(self) -> float:
        """Time by which time features are divided [s]: the setting, else the time limit, else one
        hour."""
        limit = None if self.episode.max_steps is None else self.episode.max_steps * self.clock.dt
        return self.observation.time_scale or limit or 3600.0
