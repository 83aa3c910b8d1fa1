"""``UavEnv``: the simulation and the server node as a TorchRL environment without delays."""

import copy
from collections.abc import Collection
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.data.utils import DEVICE_TYPING
from torchrl.envs import EnvBase
from torchrl.envs.utils import make_composite_from_td

from damian import keys
from damian.common import checks, counter_rng, devices
from damian.common.tensors import gather_rows, tree_map, tree_where, where_rows
from damian.envs.config import ScenarioConfig
from damian.server.belief import certain_belief
from damian.server.components import checked_features
from damian.server.features.source import nearest_way
from damian.server.layout import Layout
from damian.server.server import Features, Server
from damian.world.requests import is_open
from damian.world.simulation import Simulation
from damian.world.state import INITIAL_CONDITION, PackedState, State, Truth

Outputs = dict[NestedKey, Tensor]
"""Entries that a step or a reset outputs, by key."""

Bounds = dict[NestedKey, tuple[Tensor, Tensor]]
"""Lowest and highest values of each column of an observation, [F] each, by key."""

EXTRAS = ("message", "state", "reward_terms")
"""Default optional outputs."""

ALL_EXTRAS = (*EXTRAS, "position", "privileged")
"""All optional outputs; ``position`` is for delay laws, ``privileged`` for reference experiments
only."""

_PAIRS_AT_ONCE = 2**20
"""Pairs of UAVs whose features are computed together for the initial conditions."""


class UavEnv(EnvBase):
    """B worlds, in each of which N UAVs search for and track a source or cover a region, without
    any delay.

    ``damian.make_env`` adds the delays and slower clocks of a scenario as transforms. The batch
    size is ``[B]``. Entries of the UAVs lie under ``"agents"``, with batch size ``[B, N]``:

    - ``action``: discrete [B, N], or continuous [B, N, 2] in [0, 1]: distance and heading
      (paper, section 4.2);
    - ``action_mask``: legal discrete actions, [B, N, A] (if ``actions.mask``);
    - ``ready``: whether the UAV can choose an action now, [B, N];
    - ``observation``, ``global_observation``: features of the actor [B, N, F] and of the critic
      [B, N, G];
    - ``message``: the latest message of each UAV, [B, N, M] (``server.messages`` names its fields),
      and
      ``message_sent``: whether it was sent in this step, [B, N];
    - ``position``: true position, east and north in the coordinates of the settings [m], [B, N, 2];
    - ``privileged_observation``: ``global_observation`` as if nothing were delayed or lost, with
      the belief that each source is in its cell, and the offset to the nearest
      (over the region's size, [-1, 1]), [B, N, G + 2];
    - ``reward``: paper, eq. 8, [B, N, 1]; ``reward_terms``: its weighted terms by name, [B, N].

    At the root lie ``state`` (the simulator's truth, never for an actor), ``success``, and
    TorchRL's ``done``, ``terminated``, ``truncated``; with ``episode.end_with_source`` also
    ``source_over`` [B, 1]. A step also reads the flag ``("agents", "action_valid")`` [B, N], if it
    exists: a UAV with a false flag does not act; and TorchRL's ``_step`` [B].

    Args:
        scenario: all settings, which are copied; the defaults if not given.
        num_worlds: number of parallel environments, B.
        seed: of the regions and initial conditions drawn at construction, and of the worlds' random
            streams.
        device: of all tensors.
        extras: which of ``message``, ``state``, ``reward_terms``, ``position`` and
            (reference experiments only) ``privileged`` are output; each costs time. Delays need
            ``message``.
        messages_only: a step outputs no observation, reward or end: a ``ServerNode`` computes them.
    """

    def __init__(
        self,
        scenario: ScenarioConfig | None = None,
        num_worlds: int = 1,
        seed: int = 0,
        device: torch.device | str = "cpu",
        extras: Collection[str] = EXTRAS,
        *,
        messages_only: bool = False,
    ) -> None:
        checks.whole("num_worlds", num_worlds, 1, checks.WORLDS)
        shape = torch.Size([num_worlds])
        super().__init__(device=torch.device("cpu"), batch_size=shape)
        self.scenario = copy.deepcopy(scenario) if scenario else ScenarioConfig()
        checks.device("device", str(device))
        self.extras = checks.names("extras", extras, ALL_EXTRAS)
        self.messages_only = messages_only
        of = self.scenario
        observation = of.observation
        belief = observation.belief
        stops = observation.carried_stops
        self.simulation = Simulation(of, of.clock.dt, stops, seed)
        self.server = Server(self.simulation, observation, of.reward, of.episode, of.time_scale)
        problem = "needs transforms before a ServerNode: build the environment by damian.make_env"
        allowed = messages_only or not belief
        checks.require(allowed, "observation.belief", belief, problem)
        told = messages_only or stops >= observation.timeline
        checks.require(told, "observation.stops", stops, problem)
        self.layout, self._reset_outputs = self._reset_tables()
        """What the columns of each observation mean, by the last part of its key."""
        self._make_specs()
        self.set_seed(seed)
        self.to(torch.device(device))

    def to(self, device: DEVICE_TYPING) -> "UavEnv":
        """Move the worlds and all tables, in place."""
        device = torch.device(device)
        if device == self.device:
            return self
        super().to(device)
        self.simulation.to(device)
        self.server.to(device)
        outputs = self._reset_outputs
        self._reset_outputs = {key: table.to(device) for key, table in outputs.items()}
        self.worlds = tree_map(lambda table: table.to(device), self.worlds)
        return self

    @property
    def n_agents(self) -> int:
        """Number of UAVs in each world, N."""
        return self.scenario.agents

    @property
    def state(self) -> State:
        """Everything in the worlds that changes; assign it to put them into another state."""
        return self.simulation.layout.unpack(self.worlds)

    @state.setter
    def state(self, state: State) -> None:
        self.worlds = self.simulation.layout.pack(state)

    def get_extra_state(self) -> dict[str, Tensor]:
        """The worlds, for ``state_dict``."""
        return self.worlds._asdict()

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Put the worlds into the state of a ``state_dict``, of as many worlds and the same
        scenario."""
        loaded = {}
        for name, own in self.worlds._asdict().items():
            loaded[name] = state[name].view_as(own).to(own, copy=True)
        self.worlds = PackedState(**loaded)

    def seed_worlds(self, seeds: Tensor) -> None:
        """Give every world its own random stream, [B] integers; the next reset begins its first
        episode.

        Until then, a world that has been reset goes on: TorchRL's collectors reset first, and seed
        afterwards.
        """
        seeds = seeds.to(self.device, torch.long)
        zero = torch.zeros_like(seeds)
        if "worlds" not in self.__dict__:
            initial = self.simulation.initial
            self.state = tree_map(lambda table: table.index_select(0, zero), initial)
        self.state = self.state._replace(seed=seeds, episode=zero)

    def _set_seed(self, seed: int | None) -> None:
        n_worlds = self.batch_size[0]
        seeds = counter_rng.world_seeds(seed or 0, n_worlds, self.device)
        self.seed_worlds(seeds)

    # Methods that TorchRL calls.

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(keys.ACTION)
        valid = tensordict.get(keys.ACTION_VALID, None)
        command = tensordict.get(keys.COMMAND, None)
        before = self.worlds
        self.worlds, outputs = self.step_fn(before, action, valid, command)
        if self.messages_only:  # TorchRL expects a reward from every environment
            outputs[keys.REWARD] = self.full_reward_spec[keys.REWARD].zero()
        stepped = tensordict.get(keys.STEPPED, None)
        # The other worlds keep their state, and repeat what they have output last.
        if stepped is not None:
            stepped = stepped.view(-1)
            self.worlds = tree_where(stepped, self.worlds, before)
            for key, new in outputs.items():
                old = tensordict.get(key, None)
                if old is None or old.shape != new.shape:  # transforms restore what they change
                    old = torch.zeros_like(new)
                outputs[key] = where_rows(stepped, new, old)
        return self.to_tensordict(outputs)

    @torch.no_grad()
    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            mask = torch.ones(self.batch_size, dtype=torch.bool, device=self.device)
        self.worlds, outputs = self.reset_fn(self.worlds, mask.view(-1))
        return self.to_tensordict(outputs)

    # Pure functions of the state, which can be compiled.

    def reset_fn(self, worlds: PackedState, mask: Tensor) -> tuple[PackedState, Outputs]:
        """Begin new episodes in the worlds of the mask [B]; the outputs are those of the new
        episodes."""
        if torch.compiler.is_compiling() or not devices.data_dependent(mask.device):
            fresh = self.simulation.next_episode(worlds)
            worlds = tree_where(mask, fresh, worlds)
        else:
            worlds = self.simulation.reset(worlds, mask)
        # A table cannot hold first readings, which differ in every episode.
        if self.simulation.draws:
            state = self.simulation.layout.unpack(worlds)
            features = self.server.features(state.sent, state.steps)
            return worlds, self._outputs_at_reset(state, features)
        condition = worlds.integers[:, INITIAL_CONDITION]
        outputs = {}
        for key, table in self._reset_outputs.items():
            outputs[key] = table.index_select(0, condition)
        return worlds, outputs

    def step_fn(
        self,
        worlds: PackedState,
        action: Tensor,
        valid: Tensor | None = None,
        command: Tensor | None = None,
    ) -> tuple[PackedState, Outputs]:
        """One step of the physics, then the server's outputs; inputs as in ``Simulation.step``."""
        layout = self.simulation.layout
        state = self.simulation.step(layout.unpack(worlds), action, valid, command)
        if self.messages_only:
            return layout.pack(state), self._state_outputs(state)
        served = self.server(state.sent, state.steps, state.source_over)
        outputs = self._state_outputs(state, served.global_observation)
        outputs |= served.entries("reward_terms" in self.extras)
        return layout.pack(state), outputs

    def _state_outputs(self, state: State, global_observation: Tensor | None = None) -> Outputs:
        """The outputs that depend on a state alone; the critic's observation [B, N, G] saves
        time."""
        vehicles = self.simulation.vehicles
        outputs: Outputs = {keys.READY: vehicles.may_choose(state)}
        actions = self.scenario.actions
        if actions.kind == "discrete" and actions.mask:
            outputs[keys.ACTION_MASK] = self.simulation.action_mask(state)
        if self.server.tells_commands:
            outputs[keys.FRAME] = state.goal
            outputs[keys.REACH] = vehicles.reach(state)
        if "message" in self.extras:
            outputs[keys.MESSAGE] = state.sent.pack()
            outputs[keys.MESSAGE_SENT] = state.message_sent
        if "position" in self.extras:
            offset = gather_rows(self.simulation.airspace.offset, state.region)
            outputs[keys.POSITION] = state.position[..., :2] + offset.unsqueeze(-2)
        if "delay.loss" in vehicles.values.choices:
            loss = torch.as_tensor(vehicles.values.get("delay.loss", state.drawn))
            outputs[keys.LOSS] = loss.unsqueeze(-1).expand(-1, self.n_agents, 1)
        if "privileged" in self.extras:
            outputs[keys.PRIVILEGED_OBSERVATION] = self._privileged(state, global_observation)
        if self.scenario.episode.end_with_source:
            outputs[keys.SOURCE_OVER] = state.source_over.unsqueeze(-1)
        if "state" in self.extras:
            _, emits, _ = self.simulation.source_now(state)
            unserved = is_open(state.requests, state.sent.served)
            places = state.requests[..., :2]
            requests = torch.cat([places, unserved.unsqueeze(-1)], -1)
            truth = Truth(state.position, state.battery, emits, state.source, requests, state.drawn)
            outputs[keys.STATE] = truth.pack()
        return outputs

    def _privileged(self, state: State, global_observation: Tensor | None) -> Tensor:
        """Observation of a critic that knows the simulator's true state, [B, N, G + 2]."""
        grid = self.server.grid
        if global_observation is None or grid is not None:
            belief = None if grid is None else certain_belief(grid, state.source)
            features = self.server.features(state.sent, state.steps, belief=belief)
            _, global_observation = self.server.observations(features)
        scale = gather_rows(self.simulation.airspace.scale, state.region)
        place = state.position[..., None, :2]
        ways = state.source.unsqueeze(-3) - place
        to_source = nearest_way(ways) / scale.view(-1, 1, 1)
        to_source = to_source.clamp(-1, 1)
        return torch.cat([global_observation, to_source], -1)

    def _reset_tables(self) -> tuple[dict[str, Layout], Outputs]:
        """Layouts of the observations, and outputs of a reset for each initial condition."""
        initial = self.simulation.initial
        n = len(initial.steps)
        layouts: dict[str, Layout] = {}
        tables: Outputs = {}
        # Some at a time: features of pairs of UAVs would take gigabytes.
        for rows in torch.arange(n).split(max(1, _PAIRS_AT_ONCE // self.n_agents**2)):
            some = tree_map(lambda field, rows=rows: field[rows], initial)
            features = checked_features(self.server, some.sent, some.steps)
            outputs = self._outputs_at_reset(some, features)
            if not tables:
                layouts = self._layouts(features)
                tables = {key: x.new_empty(n, *x.shape[1:]) for key, x in outputs.items()}
            for key, values in outputs.items():
                tables[key][rows] = values
        return layouts, tables

    def _outputs_at_reset(self, initial: State, features: Features) -> Outputs:
        """Outputs of a reset, [Q, ...] by key, from Q first states of episodes and their
        features."""
        observation, global_observation = self.server.observations(features)
        outputs = self._state_outputs(initial, global_observation)
        outputs[keys.OBSERVATION] = observation
        outputs[keys.GLOBAL_OBSERVATION] = global_observation
        if "reward_terms" in self.extras:
            zero = torch.zeros_like(initial.track)
            for name in self.scenario.reward.terms:
                outputs[*keys.REWARD_TERMS, name] = zero
        false = torch.zeros_like(initial.source_over).unsqueeze(-1)
        flags = (*keys.ENDS, keys.SUCCESS)
        return outputs | dict.fromkeys(flags, false)

    # TensorDicts and specs.

    def to_tensordict(self, outputs: Outputs) -> TensorDict:
        """Outputs as a TensorDict of batch size [B], with ``"agents"`` of batch size [B, N]."""
        shape = torch.Size((*self.batch_size, self.n_agents))
        make = TensorDict._new_unsafe  # saves 4 %
        levels: dict[tuple[str, ...], dict[str, Any]] = {(): {}, (keys.AGENTS,): {}}
        for key, value in outputs.items():
            parts = (key,) if isinstance(key, str) else cast(tuple[str, ...], key)
            *path, name = parts
            level = levels.setdefault(tuple(path), {})
            level[name] = value
        root = levels.pop(())
        agents = levels.pop((keys.AGENTS,))
        for path, level in levels.items():
            agents[path[-1]] = make(level, shape, self.device)
        root[keys.AGENTS] = make(agents, shape, self.device)
        return make(root, self.batch_size, self.device)

    def _layouts(self, features: Features) -> dict[str, Layout]:
        actor, critic = self.server.layouts(features)
        meaning = "Way from the UAV to the nearest source, over the size of the region."
        axes = ("east", "north")
        privileged = critic.appended("source_way", (2,), -1.0, 1.0, entries=axes, meaning=meaning)
        layouts = {
            keys.OBSERVATION: actor,
            keys.GLOBAL_OBSERVATION: critic,
            keys.PRIVILEGED_OBSERVATION: privileged,
        }
        return {keys.last_part(key): layout for key, layout in layouts.items()}

    def _make_specs(self) -> None:
        """Specs with the bounds that the layouts state."""
        bounds: Bounds = {
            (keys.AGENTS, name): layout.bounds() for name, layout in self.layout.items()
        }
        worlds = self.batch_size
        agents = torch.Size((*worlds, self.n_agents))
        observations = dict(self._reset_outputs)
        ends: Outputs = {key: observations.pop(key) for key in keys.ENDS}
        self.observation_spec = self._specs_of(observations, bounds)
        config = self.scenario.actions
        if config.kind == "discrete":
            action = Categorical(config.n_actions, shape=agents, device=self.device)
        else:
            shape = torch.Size((*agents, 2))
            action = Bounded(0.0, 1.0, shape=shape, device=self.device)
        shape = torch.Size((*agents, 1))
        reward = Unbounded(shape, device=self.device)
        actions = Composite(action=action, shape=agents)
        rewards = Composite(reward=reward, shape=agents)
        self.action_spec = Composite(agents=actions, shape=worlds, device=self.device)
        self.reward_spec = Composite(agents=rewards, shape=worlds, device=self.device)
        self.done_spec = self._specs_of(ends)

    def _specs_of(self, tables: Outputs, bounds: Bounds | None = None) -> Composite:
        """Specs of outputs, derived from examples with any number of rows and the bounds of
        observations."""
        found: Outputs = {}
        for key, table in tables.items():
            found[key] = table[:1].expand(*self.batch_size, *table.shape[1:])
        examples = self.to_tensordict(found).select(*found)
        specs = make_composite_from_td(examples, unsqueeze_null_shapes=False)
        for key, value in found.items():
            like: dict[str, Any] = {
                "shape": value.shape,
                "dtype": value.dtype,
                "device": self.device,
            }
            limits = (bounds or {}).get(key)
            if value.dtype == torch.bool:
                specs[key] = Categorical(2, **like)
            elif limits is not None:
                low, high = (limit.expand(value.shape) for limit in limits)
                specs[key] = Bounded(low, high, **like)
        return specs.to(self.device)
