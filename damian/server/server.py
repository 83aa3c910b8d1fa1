"""The server node computes observations, rewards and the task's status from messages
(paper, section 3.2).

The environment calls it with the latest messages sent, ``ServerNode`` with the latest received, and
the replay storage with those that have arrived by the time of learning.
"""

import itertools
from collections.abc import Collection
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey
from torch import Tensor
from torch.nn import functional as F

from damian import keys
from damian.common import checks
from damian.common.tensors import gather_rows, move_attributes
from damian.server.belief import SourceGrid
from damian.server.config import EpisodeConfig, ObservationConfig, RewardConfig
from damian.server.features import ServerContext, feature_of, layout_of, observe, observe_own, stack
from damian.server.features.base import check_features, source_grid
from damian.server.features.timeline import stop_ages, stop_facts
from damian.server.layout import Layout
from damian.server.rewards import Counters, final_reward, reward, terms_of
from damian.server.termination import Status, status
from damian.world.config import FOOTPRINT
from damian.world.messages import MAX_EXACT_INTEGER, Messages
from damian.world.signal_source import footprint_radius
from damian.world.simulation import Simulation

Features = dict[str, Tensor]


class ServerOutputs(NamedTuple):
    """Everything that the server computes from one message of each UAV."""

    observation: Tensor | None
    """Observations of the actors, [*, N, F], if they are wanted."""
    global_observation: Tensor | None
    """Observations of the critic, [*, N, G], if they are wanted."""
    reward: Tensor
    """Rewards (paper, eq. 8) with bonus and penalty, [*, N]."""
    terms: dict[str, Tensor]
    """Weighted terms of the rewards by name, [*, N] each."""
    status: Status
    """Success and the end of the episode, [*]."""

    def entries(self, reward_terms: bool = False) -> dict[NestedKey, Tensor]:
        """The outputs by their keys in a TensorDict, ``reward_terms`` only if they are wanted."""
        found: dict[NestedKey, Tensor] = {
            keys.REWARD: self.reward.unsqueeze(-1),
            **self.status.entries(),
        }
        seen = {
            keys.OBSERVATION: self.observation,
            keys.GLOBAL_OBSERVATION: self.global_observation,
        }
        found |= {key: value for key, value in seen.items() if value is not None}
        terms = self.terms if reward_terms else {}
        return found | {(*keys.REWARD_TERMS, name): term for name, term in terms.items()}


class Server:
    """Computes features, rewards and status from messages, with any leading dimensions.

    In all methods ``messages`` are one message of each UAV [*, N], ``steps`` the elapsed steps of
    the episode [*], ``source_over`` tells whether the source has finished its walk [*], ``belief``
    is the probability that each source is in each cell of ``grid`` [*, K, C], and ``timeline`` what
    is known of each UAV's stops (``ServerContext``); without them, these are the first messages of
    the episode. Time features are divided by ``time_scale`` [s].
    """

    def __init__(
        self,
        simulation: Simulation,
        observation: ObservationConfig,
        reward: RewardConfig,
        episode: EpisodeConfig,
        time_scale: float,
    ) -> None:
        airspace = simulation.airspace
        n_points = airspace.points.shape[:2].numel()
        checks.require(
            n_points < MAX_EXACT_INTEGER,
            "region.lattice_step",
            n_points,
            "are more landing points than a message can number: take a larger step",
        )
        check_features(observation)
        self.observation = observation
        self.reward = reward
        self.episode = episode
        self.dt = simulation.dt
        self._scales = airspace.scale
        self._read_terms()
        self.names: list[str] = sorted({*observation.actor, *observation.critic, *self.reads})
        widths = {name: sensor.width for name, sensor in simulation.sensors.items()}
        firsts = itertools.accumulate(widths.values(), initial=0)
        self._widths = simulation.widths
        knows = simulation.config.requests.known_at_once
        self._known_columns = Messages.request_columns(simulation.widths) if knows else None
        levels = simulation.vehicles.values.choices.get("source.level_db")
        radii = [
            footprint_radius(replace(simulation.config.source, level_db=level))
            for level in levels or ()
        ]
        self._radii = torch.tensor(radii) if radii else None
        makers = dict.fromkeys(make for name in self.names for make in feature_of(name).tables)
        self._context = ServerContext(
            now=torch.zeros(()),
            scale=torch.zeros(()),
            time_scale=time_scale,
            points=airspace.points.flatten(0, 1),
            observation=observation,
            dt=simulation.dt,
            n_points=airspace.max_points,
            radius=simulation.radius,
            readings={
                name: (first, widths[name]) for name, first in zip(widths, firsts, strict=False)
            },
            tables={make: make(simulation, observation) for make in makers},
        )

    def _read_terms(self) -> None:
        self.terms = terms_of(self.reward)
        """The terms of the reward, by name."""
        self.reads = [
            *dict.fromkeys(itertools.chain(*(each.term.reads for each in self.terms.values())))
        ]
        """Names of the features that they read."""

    def __getstate__(self) -> dict[str, Any]:
        """The state without the terms: pickle does not find a function behind its decorator."""
        return self.__dict__ | {"terms": {}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._read_terms()

    @property
    def tells_commands(self) -> bool:
        """Whether messages tell which command was executed last."""
        return self._widths.commands > 0

    @property
    def grid(self) -> SourceGrid | None:
        """Cells of the belief; None if no feature reads it."""
        return self._context.tables.get(source_grid)

    @property
    def rewards_belief(self) -> bool:
        """Whether any reward term reads the belief."""
        return any(feature_of(name).scope == "belief" for name in self.reads)

    def to(self, device: torch.device) -> "Server":
        """Move the tables to a device, in place."""
        move_attributes(self, device)
        return self

    def messages(self, rows: Tensor) -> Messages:
        """Messages from their packed rows [*, N, M], with the readings of all sensors."""
        return Messages.unpack(rows, self._widths)

    @property
    def knows_requests(self) -> bool:
        """Whether the server knows at once, without any message, which requests have appeared."""
        return self._known_columns is not None

    def with_own_knowledge(self, rows: Tensor, sent: Tensor) -> Tensor:
        """Packed messages [*, N, M] that the server holds, and with them what it knows itself.

        The requests are those in ``sent``, what each UAV would send now, [*, N, M].
        """
        if self._known_columns is None:
            return rows
        known = rows.clone()
        known[..., self._known_columns] = sent[..., self._known_columns]
        return known

    def counted(self, messages: Messages) -> Tensor:
        """Flat ids of the latest landing points that coverage counts, newest first,
        [*, N, window]."""
        return messages.trail[..., : self.observation.window]

    def region_of(self, messages: Messages) -> Tensor:
        """Index of the region to which each world's landing points belong, [*]."""
        return messages.region(self._context.n_points)

    def __call__(
        self,
        messages: Messages,
        steps: Tensor,
        source_over: Tensor | None = None,
        belief: Tensor | None = None,
        timeline: Tensor | None = None,
        observers: Collection[str] = ("actor", "critic"),
        news: Tensor | None = None,
    ) -> ServerOutputs:
        """Rewards (paper, eq. 5-8), the end of the episode (section 4.1) and what ``observers``
        observe.

        Without ``source_over`` the source never ends. ``news``: which messages the server has not
        held before, [*, N]; those of now if not given, as without delay and in hindsight.
        """
        seen = {observer: getattr(self.observation, observer) for observer in observers}
        names = sorted({*self.reads, *itertools.chain(*seen.values())})
        features = self.features(messages, steps, names, belief, timeline)
        judged = features
        if self.reward.detection == "truth":  # from here on, for all that decides and pays
            messages = messages.of_truth
            judged = self.features(messages, steps, self.reads, belief, timeline)
        over = torch.zeros_like(steps, dtype=torch.bool) if source_over is None else source_over
        if news is None:
            news = messages.time == (steps * self.dt).unsqueeze(-1)
        counters = Counters(steps, messages.motions, news)
        ended = status(messages, steps, over.view(steps.shape), self.dt, self.episode)
        terms = reward(judged, counters, self.terms)
        final = final_reward(ended, counters, self.reward).unsqueeze(-1).expand_as(messages.track)
        actor, critic = (
            stack(features, seen[x]) if x in seen else None for x in ("actor", "critic")
        )
        return ServerOutputs(actor, critic, sum(terms.values(), start=final), terms, ended)

    def features(
        self,
        messages: Messages,
        steps: Tensor,
        names: list[str] | None = None,
        belief: Tensor | None = None,
        timeline: Tensor | None = None,
    ) -> Features:
        """The features of these names, or all that an observation or a reward term needs
        (paper, Table 2)."""
        context = self._known(messages, steps)._replace(belief=belief, timeline=timeline)
        return observe(messages, context, self.names if names is None else names)

    def observations(self, features: Features) -> tuple[Tensor, Tensor]:
        """Observations of the actors [*, N, F] and of the critic [*, N, G]."""
        return stack(features, self.observation.actor), stack(features, self.observation.critic)

    def layouts(self, features: Features) -> tuple[Layout, Layout]:
        """The layouts of the actors' and the critic's observations, from features of any worlds."""
        tables = self._context.tables
        observed = self.observation
        actor, critic = (layout_of(features, x, tables) for x in (observed.actor, observed.critic))
        return actor, critic

    def observe_with_own_messages(
        self,
        received: Tensor,
        sent: Tensor,
        steps: Tensor,
        belief: Tensor | None = None,
        timeline: Tensor | None = None,
        own_timeline: Tensor | None = None,
    ) -> Tensor:
        """Observations of actors that know their own messages at once, [*, N, F].

        ``received`` and ``sent`` are packed messages [*, N, M] as the server holds them, and as the
        UAVs sent them last; ``timeline`` and ``own_timeline`` [*, N, slots, 3] are what follows
        from those that have
        arrived, and from all sent. ``belief``: that of each UAV, [*, N, K, C].
        """
        known = self.messages(own_or_others(sent, received, 1))
        both = None
        if timeline is not None and own_timeline is not None:
            both = own_or_others(own_timeline, timeline, 2)
        return self.observe_each(known, steps, belief, both)

    def commanded(self, own: Tensor, commands: Tensor) -> Messages:
        """Messages of UAVs as they will be when the commands under way have been executed, [*, N].

        ``own``: packed messages [*, N, M] as their UAVs know them; ``commands`` [*, N, K, 3] as in
        ``damian.keys``. Where a command leads is known at once, what will happen there is not. A
        command is under way if the message tells of no later one, and could tell of it.
        """
        messages = self.messages(own)
        place, number, latest = commands.unbind(-1)
        told = (messages.time / self.dt).round().unsqueeze(-1)
        under_way = (number > messages.executed) & (latest > told)
        n_under_way = under_way.sum(-1, keepdim=True)
        slot = torch.arange(messages.trail.shape[-1], device=own.device)
        from_message = slot - n_under_way + place.shape[-1]
        index = torch.where(slot < n_under_way, slot, from_message)
        trail = torch.cat([place, messages.trail], -1).gather(-1, index)
        times = torch.cat([latest * self.dt, messages.landed], -1)
        events = F.pad(messages.events, (0, 0, place.shape[-1], 0))
        there = gather_rows(self._context.points, trail[..., 0])
        moves = n_under_way > 0
        pending = commands[..., : self._widths.pending, :]
        leads_to, chosen, _ = pending.unbind(-1)
        facts = [(chosen - 1) * self.dt, chosen <= messages.executed, torch.ones_like(chosen)]
        known = torch.cat([gather_rows(self._context.points, leads_to), torch.stack(facts, -1)], -1)
        return messages._replace(
            pending=known * (chosen > 0).unsqueeze(-1),
            position=torch.where(moves, there, messages.position),
            target=torch.where(moves, there, messages.target),
            trail=trail,
            landed=times.gather(-1, index).to(times.dtype),
            events=events.take_along_dim(index.unsqueeze(-1), -2),
        )

    def observe_all_commanded(
        self,
        received: Tensor,
        commands: Tensor,
        steps: Tensor,
        belief: Tensor | None = None,
        timeline: Tensor | None = None,
    ) -> Tensor:
        """Observations of the critic from where ``commands`` will have taken UAVs, [*, N, G].

        The critic is a part of learning, which knows what all have sent.
        """
        all_sent = self.commanded(received, commands)
        names = self.observation.critic
        features = self.features(all_sent, steps, names, belief=belief, timeline=timeline)
        return stack(features, names)

    def observe_own_commanded(
        self,
        received: Tensor,
        own: Messages,
        steps: Tensor,
        belief: Tensor | None = None,
        own_belief: Tensor | None = None,
        timeline: Tensor | None = None,
    ) -> Tensor:
        """Observations of actors, which know their own commands under way, [*, N, F].

        ``own`` [*, N] is from ``commanded``, the other arguments are as in
        ``observe_with_own_messages``.
        """
        if own_belief is None and belief is not None:
            own_belief = belief.unsqueeze(-3)
            own_belief = own_belief.expand(*own_belief.shape[:-3], received.shape[-2], -1, -1)
        known = own.pack(), steps, own_belief, timeline, timeline
        return self.observe_with_own_messages(received, *known)

    def observe_each(
        self,
        known: Messages,
        steps: Tensor,
        belief: Tensor | None = None,
        timeline: Tensor | None = None,
    ) -> Tensor:
        """Observations [*, N, F] from messages and timelines [*, N, N, ...] (receiver, sender), and
        beliefs."""
        names = self.observation.actor
        return stack(self.own_features(known, steps, names, belief, timeline), names)

    def own_features(
        self,
        known: Messages,
        steps: Tensor,
        names: list[str],
        belief: Tensor | None = None,
        timeline: Tensor | None = None,
    ) -> Features:
        """Features of UAVs, [*, N, ...] each, who know messages [*, N, N] and more, as in
        ``observe_each``."""
        context = self._known(known, steps.unsqueeze(-1).expand(known.time.shape[:-1]))
        return observe_own(known, context._replace(belief=belief, timeline=timeline), names)

    def stop_facts(self, rows: Tensor) -> Tensor:
        """Where the stops have been of which packed messages [*, M] tell [m], and what happened
        there, [*, S, 2 + E]."""
        return stop_facts(self.messages(rows), self._context)

    def stop_ages(self, rows: Tensor) -> Tensor:
        """How long ago those were when the message was generated [steps], [*, S]; -1 for none."""
        return stop_ages(self.messages(rows), self._context)

    def _known(self, messages: Messages, steps: Tensor) -> ServerContext:
        """What the server knows besides the messages now."""
        context = self._context._replace(now=steps * self.dt, scale=self.scales(messages))
        if self._radii is None:
            return context
        return context._replace(radius=self._told_radius(messages), level=self.level(messages))

    def level(self, messages: Messages) -> Tensor | None:
        """Number of the drawn level of the source in each world, [*]; None if none is drawn."""
        if self._radii is None:
            return None
        return (self._told_radius(messages).unsqueeze(-1) - self._radii).abs().argmin(-1)

    def _told_radius(self, messages: Messages) -> Tensor:
        """Radius of the footprints of each world's UAVs [m], [*], if it is drawn."""
        first, _ = self._context.readings[FOOTPRINT]
        return messages.readings[..., 0, first]

    def scales(self, messages: Messages) -> Tensor:
        """Largest vertex distance of the region to which each world's landing points belong [m],
        [*]."""
        return gather_rows(self._scales, self.region_of(messages))


def own_or_others(own: Tensor, others: Tensor, inner: int) -> Tensor:
    """What each receiver knows of each sender, [*, N, N, ...]: of itself ``own``, of others
    ``others``.

    Both are [*, N, ...], with ``inner`` dimensions behind the senders.
    """
    n = own.shape[-1 - inner]
    itself = torch.eye(n, dtype=torch.bool, device=own.device).view(n, n, *[1] * inner)
    return torch.where(itself, own.unsqueeze(-2 - inner), others.unsqueeze(-2 - inner))
