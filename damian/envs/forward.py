"""Predicts late messages: copies of the world start from old messages and step until now."""

import math
from collections.abc import Callable

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import ExplorationType, set_exploration_type

from damian import keys
from damian.common import checks, counter_rng
from damian.common.errors import InputError
from damian.common.tensors import gather_rows, tree_map, tree_where, where_rows
from damian.envs.nodes import WorldTransform
from damian.server.features.base import stack
from damian.server.server import Server, own_or_others
from damian.transforms.base import Change, Memory
from damian.transforms.entries import Entries, add_spec
from damian.world.messages import Messages
from damian.world.simulation import Simulation
from damian.world.state import State

Assumed = Callable[[State, int], Tensor]
"""The actions [C, N] or [C, N, 2] that all UAVs are assumed to have chosen in the state of C
worlds, so many steps ago."""

_STREAM = counter_rng.number_of("forward")


class ForetoldWorlds(Simulation):
    """The worlds of a simulation, in which no flight is aborted and no UAV fails."""

    foretold = True

    def __init__(self, simulation: Simulation) -> None:
        self.__dict__ = simulation.__dict__  # the same tables, also on another device


class ToldWorlds(ForetoldWorlds):
    """The worlds of a simulation as messages tell of them.

    Nobody knows where sources are, so that nothing is heard there, and no request appears that is
    not known. Gusts are drawn from streams of their own.
    """

    def source_now(self, state: State) -> tuple[Tensor, Tensor, Tensor]:
        nowhere = torch.full_like(state.source, torch.inf)
        silent = torch.zeros_like(nowhere[..., 0], dtype=torch.bool)
        return nowhere, silent, silent

    def _reported(self, state: State, in_reach: Tensor, listens: Tensor) -> Tensor:
        return in_reach

    def _appear(self, state: State, now: Tensor) -> Tensor:
        return state.requests

    def state_of(self, messages: Messages, region: Tensor, steps: Tensor) -> State:
        """The state, ``steps`` [C] after the reset, that follows from each UAV's latest message,
        [C, N].

        A UAV on the ground has stood there since. ``region``: the index of that of each copy, [C].
        """
        copy = torch.arange(len(steps), device=steps.device)
        state = tree_map(lambda row: row[:1].expand(len(copy), *row.shape[1:]), self.initial)
        seed = counter_rng.bits64(torch.full_like(copy, _STREAM), copy)
        height = torch.zeros_like(messages.track).unsqueeze(-1)
        state = state._replace(
            seed=seed,
            region=region,
            steps=steps,
            position=torch.cat([messages.position, height], -1),
            track=messages.track,
            battery=messages.battery,
            motions=messages.motions.masked_fill(messages.spotted, 0),
            drawn=self.vehicles.values.draw(seed, torch.zeros_like(seed)),
            sent=messages,
        )
        since = steps.unsqueeze(-1) - (messages.time / self.dt).round().long()
        state = state._replace(message_sent=since == 0)
        return self.vehicles.resumed(state, since)

    def flown(
        self, recalled: Tensor, newest: Tensor, now: Tensor, assumed: Assumed, ahead: int = 0
    ) -> State:
        """The state of C copies ``now`` [C] steps after the reset, and so many steps ``ahead``.

        ``recalled`` [C, N, S + 1, M + 1] are the messages of the latest steps, the latest one
        first, each followed by whether it is known; ``newest`` [C, N, M] the newest known of each
        UAV. The copies begin S steps ago.
        """
        rows = recalled[..., :-1]
        known = recalled[..., -1] > 0
        steps = rows.shape[2] - 1
        age = torch.arange(steps + 1, device=now.device)
        earliest = torch.where(known, age, -1).argmax(-1)
        first = rows.take_along_dim(earliest[..., None, None], 2).squeeze(2)
        first = where_rows(known.any(-1), first, newest)
        begin = (now - steps).clamp(min=0)
        latest = self._messages(newest)
        region = latest.region(self.airspace.max_points)
        requests = latest.requests[:, 0]
        state = self.state_of(self._messages(first), region, begin)
        for back in range(steps, 0, -1):
            after = now - back + 1
            appeared = requests[..., 2:] <= (after * self.dt).view(-1, 1, 1)
            state = state._replace(requests=torch.where(appeared, requests, -1.0))
            following = self.step(state, assumed(state, back))
            told = self.state_of(self._messages(rows[:, :, back - 1]), region, after)
            following = _where_told(known[:, :, back - 1], told, following)
            state = tree_where(after > 0, following, state)
        for step in range(ahead):
            state = self.step(state, assumed(state, -step))
        return state

    def towards(self, standing: Tensor, goals: Tensor, mask: Tensor | None = None) -> Tensor:
        """The actions that lead nearest to the landing points ``goals`` from others, flat ids
        [*, N] each."""
        nearest = gather_rows(self.candidates.nearest, standing)
        ways = gather_rows(self.points, nearest) - gather_rows(self.points, goals).unsqueeze(-2)
        left = ways.square().sum(-1)
        if mask is not None:
            left = left.where(mask, torch.inf)
        return left.argmin(-1)

    def _messages(self, rows: Tensor) -> Messages:
        return Messages.unpack(rows, self.widths)


def longest_flight(simulation: Simulation) -> int:
    """Steps of the longest flight in still air, during which a UAV sends nothing; 0 if flights
    take no time."""
    vehicles = simulation.vehicles
    if vehicles.instant:
        return 0
    start = simulation.initial
    length = start.track.new_full(start.track.shape, max(simulation.config.actions.distances))
    seconds = 2 * vehicles.vertical(start) + vehicles.shortest_time(length, start.drawn)
    return math.ceil(seconds.amax().item() / simulation.dt)


class Forward(WorldTransform):
    """Writes the messages that each UAV expects to be sent now, by a model of the world.

    For each UAV a copy of the world begins with what it knows was true as long ago as the messages
    that it recalls reach, and steps until now. In each step every UAV does what the messages of
    that step tell, as far as they have arrived, and else what ``assumed`` chooses in the copy.
    Where nothing is random and everybody follows what is assumed, the messages are those that an
    undelayed server holds. If commands are executed ``late`` steps after they are sent, the copies
    step on until those that are sent now will be, and a UAV does in its own what it has sent.

    Args:
        simulation: of the worlds.
        received_key: key of the packed messages that have arrived.
        masks: also write which actions are legal in the copies.
        late: delay of absolute commands [steps].
        hold: action that is executed until the first command arrives.
    """

    stage = "server"

    def __init__(
        self,
        simulation: Simulation,
        received_key: NestedKey = keys.RECEIVED,
        *,
        masks: bool = False,
        late: int = 0,
        hold: int = 0,
    ) -> None:
        written: list[NestedKey] = [keys.FORWARD, *[keys.FORWARD_MASK] * masks]
        super().__init__([keys.MESSAGE], written)
        self.worlds = ToldWorlds(simulation)
        self.received_key = received_key
        self.masks = masks
        self.late = late
        self.hold = hold
        self.assumed: Assumed | None = None
        """What everybody is assumed to choose; ``DelayedEnv.assume`` hands it in."""
        self.step_keys = [keys.MESSAGE, received_key, keys.RECALLED, keys.OWN_RECALLED]
        self.step_keys += [keys.ACTION_MASK] * masks + [keys.COMMANDS] * (late > 0)

    def init_memory(self, tensordict: TensorDictBase) -> Memory:
        device = tensordict.get(keys.MESSAGE).device
        return {"elapsed": torch.zeros(self.rows.numel(), dtype=torch.long, device=device)}

    def on_reset(self, memory: Memory, entries: Entries, mask: Tensor) -> Change:
        n = entries[keys.MESSAGE].shape[1]
        everyone: Entries = {keys.FORWARD: entries[keys.MESSAGE]}
        if self.masks:
            everyone[keys.FORWARD_MASK] = entries[keys.ACTION_MASK]
        written: Entries = {
            key: value.unsqueeze(1).expand(-1, n, *value.shape[1:]).clone()
            for key, value in everyone.items()
        }
        return {"elapsed": memory["elapsed"].masked_fill(mask, 0)}, written

    def on_step(self, memory: Memory, entries: Entries) -> Change:
        if self.assumed is None:
            raise InputError("observation.forward: hand in what to assume by env.assume(policy)")
        now = memory["elapsed"] + 1
        sent = entries[keys.MESSAGE]
        n_worlds, n = sent.shape[:2]
        recalled = own_or_others(entries[keys.OWN_RECALLED], entries[keys.RECALLED], 2)
        newest = own_or_others(sent, entries[self.received_key], 1)
        copies = recalled.flatten(0, 1), newest.flatten(0, 1), now.repeat_interleave(n, 0)
        assumed = self.assumed
        if self.late:
            assumed = self._with_own(assumed, entries[keys.COMMANDS])
        state = self.worlds.flown(*copies, assumed, self.late)
        flown = state.sent.pack().view(n_worlds, n, n, -1)
        if not self.late:
            itself = torch.eye(n, dtype=torch.bool, device=sent.device).unsqueeze(-1)
            flown = torch.where(itself, sent.unsqueeze(1), flown)
        written: Entries = {keys.FORWARD: flown}
        if self.masks:
            mask = self.worlds.action_mask(state)
            written[keys.FORWARD_MASK] = mask.view(n_worlds, n, n, -1)
        return {"elapsed": now}, written

    def _with_own(self, assumed: Assumed, commands: Tensor) -> Assumed:
        """The actions in each copy: the observer executes the commands that it has sent, ``commands``
        [B, N, K, 3], others do what is assumed, and all hold until the first command arrives."""
        observer = torch.arange(commands.shape[1], device=commands.device)
        observer = observer.repeat(len(commands)).unsqueeze(-1)
        place, _, latest = commands.flatten(0, 1).unbind(-1)

        def choose(state: State, back: int) -> Tensor:
            actions = assumed(state, back)
            after = (state.steps + 1).unsqueeze(-1)
            sent = torch.where(latest == after, place, -1).amax(-1, keepdim=True)
            own = self.worlds.towards(state.goal.gather(1, observer), sent.clamp(min=0))
            own = torch.where(sent < 0, actions.gather(1, observer), own)
            actions = actions.scatter(1, observer, own)
            return actions.where(after > self.late, self.hold)

        return choose

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:  # type: ignore[override]
        message = observation_spec[keys.MESSAGE].shape
        n = message[-2]
        add_spec(observation_spec, keys.FORWARD, (*message[:-1], *message[-2:]))
        if self.masks:
            mask = observation_spec[keys.ACTION_MASK].shape
            shape = (*mask[:-1], n, mask[-1])
            add_spec(observation_spec, keys.FORWARD_MASK, shape, torch.bool)
        return observation_spec


_OF_UAVS = (
    "origin",
    "goal",
    "elapsed",
    "vertical",
    "cruise",
    "cruise_before",
    "air",
    "failed",
    "battery_before",
    "position",
    "track",
    "battery",
    "motions",
    "message_sent",
)
"""Fields of a state, beside ``sent``, that have a row for each UAV and follow from its messages."""


def _where_told(known: Tensor, told: State, flown: State) -> State:
    """The state of copies: ``told`` for UAVs whose messages are ``known`` [C, N], else ``flown``."""
    replaced = {}
    for name in _OF_UAVS:
        replaced[name] = where_rows(known, getattr(told, name), getattr(flown, name))
    sent = tree_where(known, told.sent, flown.sent)
    return flown._replace(**replaced, sent=sent)


def assumed_policy(simulation: Simulation, server: Server, policy: TensorDictModuleBase) -> Assumed:
    """For ``DelayedEnv.assume``: everybody is assumed to take the most likely action of a policy,
    who observes the copies without any delay.

    Raises:
        InputError: the policy remembers, or reads more than observation and mask.
    """
    read = {*policy.in_keys} - {keys.OBSERVATION, keys.ACTION_MASK}
    checks.require(
        not read,
        "observation.forward",
        "policy",
        "reads no more than the observation: leave out model.rnn, or observation.forward",
    )
    names = server.observation.actor

    def choose(state: State, _: int) -> Tensor:
        observation = stack(server.features(state.sent, state.steps, names), names)
        entries = {"observation": observation}
        if keys.ACTION_MASK in policy.in_keys:
            entries["action_mask"] = simulation.action_mask(state)
        agents = TensorDict(entries, observation.shape[:2])
        seen = TensorDict({keys.AGENTS: agents}, observation.shape[:1])
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return policy(seen)[keys.ACTION]

    return choose
