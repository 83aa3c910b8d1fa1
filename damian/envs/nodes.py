"""Transforms with a row for each world: server node (paper, section 3.4), belief, and totals."""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite

from damian import keys
from damian.common.tensors import expand_mask, gather_rows
from damian.server.belief import (
    Beliefs,
    SourceGrid,
    Window,
    advance_beliefs,
    begin_beliefs,
    empty_window,
    places,
    report_rows,
)
from damian.server.server import Server, own_or_others
from damian.transforms.base import Change, Memory, StatefulTransform
from damian.transforms.entries import Entries, add_spec, existing
from damian.world.simulation import Simulation


class WorldTransform(StatefulTransform):
    """Base class of transforms whose memory has a row for each world, whatever entries they
    read."""

    @property
    def row_key(self) -> NestedKey:
        return keys.DONE


class Drop(WorldTransform):
    """Removes entries, as far as there are any, that nothing reads after it: each one costs
    time."""

    stage = "history"

    def __init__(self, dropped_keys: Sequence[NestedKey]) -> None:
        super().__init__()
        self.dropped_keys = dropped_keys

    def _write(self, tensordict: TensorDictBase, change: Change) -> TensorDictBase:
        return tensordict.exclude(*self.dropped_keys, inplace=True)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        for key in [*observation_spec.keys(True, True)]:
            if key in self.dropped_keys:
                del observation_spec[key]
        return observation_spec


class ServerNode(WorldTransform):
    """Computes observations, rewards and the task's status from the messages that have arrived.

    It writes the entries that ``UavEnv`` writes itself when no message is delayed, and, into the
    messages that it holds, what the server knows without them; after a reset, the server, and every
    UAV, holds the first message of every UAV. ``damian.make_env`` adds it where a scenario delays
    or loses messages, or UAVs hear each other.

    Args:
        server: server node that does the computations.
        message_key: key of the packed messages that the server holds, [B, N, M].
        heard_key: key of the packed messages from which the UAVs compute their own observations, by
            the same formulas, [B, N, N, M] (receiver, sender); None if they get them from the
            server.
        reward_terms: also write the weighted terms of the reward, ``("agents", "reward_terms")``.
        simulation: of the worlds, if commands are absolute and late: actors, critic and action
            masks then see each UAV where the commands that it has sent will have taken it.
    """

    stage = "server"
    created_keys = ()  # type: ignore[assignment]  # it writes again what the environment has written

    def __init__(
        self,
        server: Server,
        message_key: NestedKey = keys.RECEIVED,
        *,
        heard_key: NestedKey | None = None,
        reward_terms: bool = False,
        simulation: Simulation | None = None,
    ) -> None:
        names = server.reward.terms if reward_terms else []
        created = [keys.OBSERVATION, keys.GLOBAL_OBSERVATION, keys.REWARD]
        created += [(*keys.REWARD_TERMS, name) for name in names]
        super().__init__([message_key], [*created, keys.SUCCESS, *keys.ENDS])
        self.server = server
        self.heard_key = heard_key
        self.reward_terms = reward_terms
        self.simulation = simulation
        of_commands = [keys.COMMANDS, keys.REACH, keys.READY] if simulation else []
        self.own_key = keys.MESSAGE if server.observation.own else None
        own = server.observation.own
        timeline = server.observation.timeline > 0
        self.belief_keys = [keys.BELIEF, keys.OWN_BELIEF][: 1 + own] if server.grid else []
        is_late = message_key != keys.MESSAGE
        self.known_key = keys.MESSAGE if server.knows_requests and is_late else None
        # Without them a timeline follows from the newest messages alone.
        stops = [keys.STOPS, keys.OWN_STOPS, keys.HEARD_STOPS] if timeline else []
        self.step_keys = [*self.required_keys, keys.SOURCE_OVER, *stops, *of_commands]

    @property
    def required_keys(self) -> Sequence[NestedKey]:
        read = [*self.in_keys, self.heard_key, self.own_key, self.known_key]
        return existing([*read, *self.belief_keys])

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        rows = tensordict.get(self.in_keys[0])
        elapsed = torch.zeros(self.rows.numel(), dtype=torch.long, device=rows.device)
        # When the messages were sent that the server held.
        return {"elapsed": elapsed, "held": torch.zeros_like(rows[..., 0])}

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        begun = {"elapsed": mask, "held": mask.unsqueeze(-1)}
        return {name: memory[name].masked_fill(rows, 0) for name, rows in begun.items()}, {}

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        elapsed = memory["elapsed"] + 1
        received = entries[self.in_keys[0]]
        sent = entries.get(keys.MESSAGE, received)
        if self.known_key:
            received = self.server.with_own_knowledge(received, sent)
        steps = elapsed.view(self.rows)
        messages = self.server.messages(received)
        news = messages.time != memory["held"]
        over = entries.get(keys.SOURCE_OVER)
        belief = entries.get(keys.BELIEF)
        timeline = entries.get(keys.STOPS)
        observers = () if self.simulation else ("actor", "critic")
        remembered = belief, timeline, observers, news
        outputs = self.server(messages, steps, over, *remembered)
        written = outputs.entries(self.reward_terms)
        if self.known_key:
            written[self.in_keys[0]] = received
        if self.simulation:
            written |= self._in_frames(self.simulation, received, entries, steps)
        if self.heard_key:
            rows = self.server.with_own_knowledge(entries[self.heard_key], sent.unsqueeze(-3))
            heard = self.server.messages(rows)
            heard_timeline = None
            if keys.HEARD_STOPS in entries:
                heard_timeline = _by_sender(entries[keys.HEARD_STOPS])
            elif timeline is not None:
                heard_timeline = own_or_others(entries[keys.OWN_STOPS], timeline, 2)
            written[keys.OBSERVATION] = self.server.observe_each(
                heard, steps, timeline=heard_timeline
            )
        elif self.own_key and not self.simulation:
            written[keys.OBSERVATION] = self.server.observe_with_own_messages(
                received,
                entries[self.own_key],
                steps,
                entries.get(keys.OWN_BELIEF),
                timeline,
                entries.get(keys.OWN_STOPS),
            )
        return {"elapsed": elapsed, "held": messages.time.clone()}, written

    def _in_frames(
        self, simulation: Simulation, received: Tensor, entries: Entries, steps: Tensor
    ) -> Entries:
        """What UAVs see and may do from where the commands that they have sent will have taken
        them."""
        own = entries[self.own_key] if self.own_key else received
        belief, own_belief, timeline = (
            entries.get(key) for key in (keys.BELIEF, keys.OWN_BELIEF, keys.STOPS)
        )
        sent = entries[keys.COMMANDS]
        seen = self.server.observe_all_commanded(received, sent, steps, belief, timeline)
        written: Entries = {keys.GLOBAL_OBSERVATION: seen}
        if self.heard_key:  # flown forward, until the commands will have been executed
            uav = torch.arange(own.shape[-2], device=own.device)
            messages = self.server.messages(entries[self.heard_key][..., uav, uav, :])
        else:
            messages = self.server.commanded(own, sent)
            known = messages, steps, belief, own_belief, timeline
            written[keys.OBSERVATION] = self.server.observe_own_commanded(received, *known)
        frame = simulation.bound_for(messages)
        actions = simulation.config.actions
        if actions.kind == "discrete" and actions.mask:
            reach = torch.where(entries[keys.READY], entries[keys.REACH], -1.0)
            distance = gather_rows(simulation.candidates.distance, frame)
            written[keys.ACTION_MASK] = simulation.legal(distance, reach)
        return written | {keys.FRAME: frame}


def _by_sender(own_first: Tensor) -> Tensor:
    """Timelines of receivers [B, N, N, K, C], whose senders begin with the receiver, in the order
    of senders."""
    agent = torch.arange(own_first.shape[1], device=own_first.device)
    receiver = agent.unsqueeze(-1)
    return own_first[:, receiver, (agent - receiver) % len(agent)]


class Belief(WorldTransform):
    """Writes the probability that each source is in each cell of a grid, by Bayes' rule.

    The belief is exact for the messages that have arrived by now, whenever they were sent: when one
    comes in late, the filter runs again from the step in which it was sent. It writes ``belief``
    [B, K, C] and, if ``own``, that of each UAV, which knows its own messages at once,
    ``("agents", "belief")`` [B, N, K, C].

    Args:
        server: server node, whose grid the belief is about.
        longest: longest delay of a message [steps].
        delayed: whether the delays of the messages are in ``("agents", "delay")``; if not, none is
            delayed.
        own: compute the belief of each UAV too.
    """

    def __init__(self, server: Server, longest: int, *, delayed: bool, own: bool = False) -> None:
        reads: list[NestedKey] = [
            keys.MESSAGE,
            keys.MESSAGE_SENT,
            *([keys.DELAY] if delayed else []),
        ]
        super().__init__(reads, [keys.BELIEF, *([keys.OWN_BELIEF] if own else [])])
        self.server = server
        self.longest = longest
        self.delayed = delayed
        self.own = own
        self.step_keys = reads

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        n_beliefs = self.rows.numel() * self.grid.n_sources
        n_agents = tensordict[keys.MESSAGE].shape[-2]
        return empty_window(self.grid, self.longest, n_beliefs, n_agents, self.own)._asdict()

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        report, place = self._told(self.to_rows(entries[keys.MESSAGE]))
        told = report, place, self._of_each(mask)
        return memory, self._written(begin_beliefs(self.grid, Window(**memory), *told))

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        rows = {key: self.to_rows(entries[key]) for key in self.in_keys}
        sent = rows[keys.MESSAGE_SENT]
        report, place = self._told(rows[keys.MESSAGE], sent)
        delay = rows[keys.DELAY].squeeze(-1) if self.delayed else torch.zeros_like(sent).long()
        every = torch.ones_like(sent[:, 0])
        stepped = entries[keys.STEPPED].reshape(-1) if keys.STEPPED in entries else every
        told = report, self._of_each(delay), place, self._of_each(stepped)
        window, beliefs = advance_beliefs(self.grid, Window(**memory), *told)
        return window._asdict(), self._written(beliefs)

    def _told(self, message: Tensor, sent: Tensor | bool = True) -> tuple[Tensor, Tensor]:
        """What messages [B, N, M], if ``sent`` [B, N], report of each source, [B K, N], and the
        places of its tables, [B K]."""
        messages = self.server.messages(message)
        level = self.server.level(messages)
        report = report_rows(self.grid, messages, level, sent)
        place = places(self.grid, self.server.region_of(messages), level)
        return report.flatten(0, 1), place.flatten()

    def _of_each(self, values: Tensor) -> Tensor:
        """Values of worlds [B, ...] for the belief about each source, [B K, ...]."""
        return values.repeat_interleave(self.grid.n_sources, 0)

    def _written(self, beliefs: Beliefs) -> Entries:
        server, own = (each.unflatten(0, (-1, self.grid.n_sources)) for each in beliefs)
        pairs = zip(
            self.out_keys, (server, own.transpose(1, 2)), strict=False
        )  # own ones if they are wanted
        return {key: self.from_rows(belief.contiguous()) for key, belief in pairs}

    @property
    def grid(self) -> SourceGrid:
        """The grid of the server, which it has if a feature reads the belief."""
        assert self.server.grid is not None
        return self.server.grid

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        worlds = observation_spec[keys.MESSAGE].shape[:-2]
        n_agents = observation_spec[keys.MESSAGE].shape[-2]
        cells = self.grid.n_sources, self.grid.prior.shape[-1]
        for key, shape in ((keys.BELIEF, worlds), (keys.OWN_BELIEF, (*worlds, n_agents))):
            if key in self.out_keys:
                size = torch.Size((*shape, *cells))
                observation_spec[key] = Bounded(0.0, 1.0, size, device=observation_spec.device)
        return observation_spec


class EpisodeTotals(WorldTransform):
    """Writes each episode's sum of rewards and number of steps
    (TorchRL's ``RewardSum``, ``StepCounter``)."""

    stage = "history"

    def __init__(self) -> None:
        super().__init__(keys.REWARD, [keys.EPISODE_REWARD, keys.STEP_COUNT])
        self.step_keys = self.in_keys

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        reward = self.env.full_reward_spec[keys.REWARD].zero()
        return {
            "total": reward,
            "count": torch.zeros(len(reward), 1, dtype=torch.long, device=reward.device),
        }

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        memory = {name: old.masked_fill(expand_mask(mask, old), 0) for name, old in memory.items()}
        return memory, self._outputs(memory)

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        memory = {"total": memory["total"] + entries[keys.REWARD], "count": memory["count"] + 1}
        return memory, self._outputs(memory)

    def _outputs(self, memory: Memory) -> Entries:
        # Copies, because others may change what a step outputs in place.
        return {
            keys.EPISODE_REWARD: memory["total"].clone(),
            keys.STEP_COUNT: memory["count"].clone(),
        }

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        reward = self.env.full_reward_spec[keys.REWARD]
        add_spec(observation_spec, keys.EPISODE_REWARD, reward.shape, reward.dtype)
        add_spec(observation_spec, keys.STEP_COUNT, (*observation_spec.shape, 1), torch.long)
        return observation_spec
