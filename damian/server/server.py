"""The server node computes observations, rewards and the task's status from messages (paper, section 3.2).

Every formula exists once: the environment calls the server with the latest messages sent, the
``ServerNode`` transform with the latest received, and the replay storage with those that have arrived by the
time of learning.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from damian.common import checks
from damian.common.tensors import gather_rows
from damian.server.belief import SourceGrid, build_source_grid, certain_belief
from damian.server.features import (
    ObservationConfig,
    ServerContext,
    check_features,
    observe,
    observe_own,
    stack,
)
from damian.server.rewards import Counters, RewardConfig, features_read, final_reward, reward
from damian.server.termination import EpisodeConfig, Status, status
from damian.world.airspace import Airspace
from damian.world.battery import BatteryConfig
from damian.world.coverage import FootprintTables, KnownCoverage, build_tables
from damian.world.messages import MAX_EXACT_INTEGER, Messages
from damian.world.signal_source import SourceConfig

Features = dict[str, Tensor]


class RewardAndStatus(NamedTuple):
    """The UAVs' rewards and the status of the task; fields as in ``ServerOutputs``."""

    reward: Tensor
    terms: dict[str, Tensor]
    status: Status


class ServerOutputs(NamedTuple):
    """Everything that the server computes from one message of each UAV."""

    observation: Tensor
    """Observations of the actors, [*, N, F]."""
    global_observation: Tensor
    """Observations of the critic, [*, N, G]."""
    reward: Tensor
    """Rewards (paper, eq. 8) with bonus and penalty, [*, N]."""
    terms: dict[str, Tensor]
    """Weighted terms of the rewards by name, [*, N] each."""
    status: Status
    """Success and the end of the episode, [*]."""
    coverage: KnownCoverage | None
    """For the next step, if ``Server.remembers_coverage``."""


class Server:
    """Computes features, rewards and status from messages, with any leading dimensions.

    In all methods ``messages`` are one message of each UAV [*, N], ``steps`` the elapsed steps of the episode
    [*], ``source_over`` tells whether the source has finished its walk [*], ``coverage`` is that of an
    earlier step of the same worlds, which saves time, and ``belief`` the probability that the source is in
    each cell of ``grid`` [*, K]; without it, these are the first messages of the episode.

    Args:
        observation: which features the actor and the critic observe.
        reward: weights of the reward terms.
        episode: when an episode ends.
        battery: gives the resolution with which battery levels are observed.
        airspace: regions and landing points.
        radius: radius of a UAV's footprint [m].
        dt: length of a step [s].
        time_scale: times are divided by this [s].
        readings: width of each reading that messages carry, by name, in their order; none if not given.
        stops: whether UAVs stay at a landing point for more than a step, so that coverage changes seldom.
        source: settings of the source, of which the belief knows how it moves and emits.
        goals: for ``belief_gain``, as in ``ServerContext``.
    """

    def __init__(
        self,
        observation: ObservationConfig,
        reward: RewardConfig,
        episode: EpisodeConfig,
        battery: BatteryConfig,
        airspace: Airspace,
        *,
        radius: float,
        dt: float,
        time_scale: float,
        readings: Mapping[str, int] | None = None,
        stops: bool = False,
        source: SourceConfig | None = None,
        goals: Tensor | None = None,
    ) -> None:
        n_points = airspace.points.shape[:2].numel()
        should = "are more landing points than a message can number: take a larger step"
        checks.require(n_points < MAX_EXACT_INTEGER, "region.lattice_step", n_points, should)
        check_features(observation)
        self.observation, self.reward, self.episode, self.battery = observation, reward, episode, battery
        self.dt, self.time_scale = dt, time_scale
        widths = readings or {}
        firsts = itertools.accumulate(widths.values(), initial=0)
        self._readings = {name: (first, widths[name]) for name, first in zip(widths, firsts, strict=False)}
        self._n_readings = sum(widths.values())
        self._names = sorted({*observation.actor, *observation.critic, *features_read(reward)})
        self._scale = airspace.scale
        self._max_points = airspace.max_points
        self._points = airspace.points.flatten(0, 1)
        self._footprints: FootprintTables | None = None
        if "coverage" in self._names:
            polygons = [region.polygon for region in airspace.regions]
            places = airspace.points.double().cpu().numpy()
            self._footprints = build_tables(polygons, places, radius)
        self.grid: SourceGrid | None = None
        """Cells of the belief; None if no feature reads it."""
        if observation.belief:
            cell = observation.belief_cell
            self.grid = build_source_grid(airspace, source or SourceConfig(), radius, dt, cell)
        self._radius, self._goals = radius, goals
        self.remembers_coverage = stops and self._footprints is not None

    def to(self, device: torch.device) -> "Server":
        """Move the tables to a device, in place."""
        self._scale, self._points = self._scale.to(device), self._points.to(device)
        if self._footprints is not None:
            self._footprints = self._footprints.to(device)
        if self.grid is not None:
            self.grid = self.grid.to(device)
        if self._goals is not None:
            self._goals = self._goals.to(device)
        return self

    def messages(self, rows: Tensor) -> Messages:
        """Messages from their packed rows [*, N, M], with the readings of all sensors."""
        return Messages.unpack(rows, self._n_readings)

    def action_columns(self, features: Features) -> slice | None:
        """The columns of the actors' observations that hold ``belief_gain``; None if there are none."""
        names = self.observation.actor
        if "belief_gain" not in names:
            return None
        parts = [stack(features, [name]).shape[-1] for name in names[: names.index("belief_gain") + 1]]
        return slice(sum(parts[:-1]), sum(parts))

    def region_of(self, messages: Messages) -> Tensor:
        """Index of the region to which each world's landing points belong, [*]."""
        return messages.region(self._max_points)

    def __call__(
        self,
        messages: Messages,
        steps: Tensor,
        source_over: Tensor | None = None,
        coverage: KnownCoverage | None = None,
        belief: Tensor | None = None,
    ) -> ServerOutputs:
        """Observations, rewards and status; without ``source_over`` the source never ends."""
        over = torch.zeros_like(steps, dtype=torch.bool) if source_over is None else source_over
        features = self.features(messages, steps, coverage=coverage, belief=belief)
        result = self.reward_and_status(features, messages, steps, over.view(steps.shape))
        known = KnownCoverage(messages.trail, features["coverage"]) if self.remembers_coverage else None
        return ServerOutputs(*self.observations(features), *result, known)

    def features(
        self,
        messages: Messages,
        steps: Tensor,
        names: list[str] | None = None,
        coverage: KnownCoverage | None = None,
        belief: Tensor | None = None,
    ) -> Features:
        """The features of these names, or all that an observation or a reward term needs (paper, Table 2)."""
        context = self._context(messages, steps)._replace(coverage=coverage, belief=belief)
        return observe(messages, context, names or self._names)

    def privileged_features(self, messages: Messages, steps: Tensor, source: Tensor) -> Features:
        """The features of somebody who knows where the source is, [*, 2] metres."""
        belief = None if self.grid is None else certain_belief(self.grid, source)
        return self.features(messages, steps, belief=belief)

    def observations(self, features: Features) -> tuple[Tensor, Tensor]:
        """Observations of the actors [*, N, F] and of the critic [*, N, G]."""
        return stack(features, self.observation.actor), stack(features, self.observation.critic)

    def observe_with_timely_messages(
        self,
        received: Tensor,
        sent: Tensor,
        steps: Tensor,
        on_time: Tensor | None = None,
        fields: Sequence[str] = Messages._fields,
        belief: Tensor | None = None,
    ) -> Tensor:
        """Observations of actors that receive some messages without delay, [*, N, F].

        Args:
            received: packed messages that the server holds, [*, N, M].
            sent: packed messages that the UAVs sent last, [*, N, M].
            steps: elapsed steps of the episode, [*].
            on_time: element (i, j) tells whether UAV i receives the messages of UAV j without delay, [N, N]
                bool; if not given, each UAV receives only its own without delay.
            fields: fields of these messages that are received without delay; the server provides the others.
            belief: that of each UAV, [*, N, K].
        """
        n_agents = received.shape[-2]
        if on_time is None:
            on_time = torch.eye(n_agents, dtype=torch.bool, device=received.device)
        timely = torch.where(on_time.unsqueeze(-1), sent.unsqueeze(-3), received.unsqueeze(-3))
        known = self.messages(received.unsqueeze(-3).expand_as(timely))  # [*, N receivers, N senders]
        timely = self.messages(timely)._asdict()
        return self.observe_each(known._replace(**{name: timely[name] for name in fields}), steps, belief)

    def observe_each(self, known: Messages, steps: Tensor, belief: Tensor | None = None) -> Tensor:
        """Observations of actors each of which knows messages of its own, [*, N, F].

        Args:
            known: the message of each UAV that each UAV knows, [*, N, N] (receiver, sender).
            steps: elapsed steps of the episode, [*].
            belief: that of each UAV, [*, N, K].
        """
        context = self._context(known, steps.unsqueeze(-1).expand(known.time.shape[:-1]))
        context = context._replace(belief=belief)
        return stack(observe_own(known, context, self.observation.actor), self.observation.actor)

    def reward_and_status(
        self, features: Features, messages: Messages, steps: Tensor, source_over: Tensor
    ) -> RewardAndStatus:
        """Rewards (paper, eq. 5-8) and the end of the episode (section 4.1); features are of the messages."""
        counters = Counters(steps, messages.motions)
        ended = status(messages, steps, source_over, self.dt, self.episode)
        terms = reward(features, counters, self.reward)
        final = final_reward(ended, counters, self.reward).unsqueeze(-1).expand_as(messages.track)
        return RewardAndStatus(sum(terms.values(), start=final), terms, ended)

    def _context(self, messages: Messages, steps: Tensor) -> ServerContext:
        """What the server knows besides the messages."""
        return ServerContext(
            now=steps * self.dt,
            scale=self.scales(messages),
            time_scale=self.time_scale,
            battery=self.battery,
            footprints=self._footprints,
            points=self._points,
            age_scale=self.observation.age_scale,
            newest=self.observation.estimate == "newest",
            readings=self._readings,
            radius=self._radius,
            n_points=self._max_points,
            goals=self._goals,
            grid=self.grid,
        )

    def scales(self, messages: Messages) -> Tensor:
        """Largest vertex distance of the region to which each world's landing points belong [m], [*]."""
        region = self.region_of(messages)
        return self._scale.expand(region.shape) if len(self._scale) == 1 else gather_rows(self._scale, region)
