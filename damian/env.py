"""``UavEnv``: the simulation as a TorchRL environment. Keys and specs are set here only."""

import os
from collections.abc import Callable, Collection
from typing import Any

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, TensorSpec, Unbounded
from torchrl.data.utils import DEVICE_TYPING
from torchrl.envs import EnvBase

from damian.features import Server, observe, stack
from damian.rewards import Counters, final_reward, reward, status
from damian.scenario import ScenarioConfig
from damian.simulation import Simulation
from damian.state import SITUATION, Rows, State, tree_map
from damian.world import draws
from damian.world.airspace import rows
from damian.world.coverage import FootprintTables, build_tables

Shown = dict[str, Any]
"""What a step shows, as nested dictionaries of tensors."""

EXTRAS = ("message", "state", "reward_terms")


class UavEnv(EnvBase):
    """B worlds in which N UAVs search for, track and cover things; nothing is delayed here.

    Batch size ``[B]``. What belongs to the UAVs stands under ``"agents"``, batch size ``[B, N]``:

    - ``action``: discrete [B, N], or continuous [B, N, 2] in [0, 1] (SPEC 2);
    - ``action_mask``: discrete actions that would do something, [B, N, A] (if ``actions.mask``);
    - ``ready``: may the UAV choose now, [B, N];
    - ``observation``, ``global_observation``: features of the actor [B, N, F], of the critic [B, N, G];
    - ``message``: the latest message of each UAV (the fields of ``Snapshot``), ``talks``: sent just now;
    - ``reward``: eq. 8, [B, N, 1]; ``reward_terms``: its weighted terms by name, [B, N].

    At the root stand ``state`` (simulator truth: for drawing and reference arms, never for an actor),
    ``success``, and TorchRL's ``done``, ``terminated``, ``truncated``.

    Args:
        scenario: what a world is made of.
        num_worlds: B.
        seed: of the regions and situations drawn at construction, and of the worlds' streams.
        device: where everything lives.
        extras: which of ``message``, ``state`` and ``reward_terms`` are shown; each costs time, so leave
            out what nobody reads (delays read the messages).

    ``UavEnv(..., compile=True)`` compiles the step (half a minute at first, then up to twice as fast).

    Raises:
        InputError: the scenario asks for something impossible.
    """

    def __init__(
        self,
        scenario: ScenarioConfig | None = None,
        num_worlds: int = 1,
        seed: int = 0,
        device: torch.device | str = "cpu",
        extras: Collection[str] = EXTRAS,
    ) -> None:
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([num_worlds]))
        self.scenario = scenario or ScenarioConfig()
        self.extras = frozenset(extras)
        self.simulation = Simulation(self.scenario, seed)
        observation, task = self.scenario.observation, self.scenario.task
        self._wanted = sorted({*observation.actor, *observation.critic, *task.terms})
        self._footprints = self._build_footprints() if "coverage" in self._wanted else None
        first = self.simulation.initial
        self._first = self._show(first, self._features(first))
        self._make_specs()
        self.set_seed(seed)
        self._advance = self._play
        self.to(torch.device(device))

    def compile(self, **options: Any) -> "UavEnv":
        """Compile what a step computes, as one graph, in place of TorchRL's bookkeeping around it.

        Args:
            options: for ``torch.compile``, in place of what suits a CPU.
        """
        options = options or {"options": _INDUCTOR}
        # Every environment has a graph of its own: it never meets another's scenario.
        self._advance = torch.compile(  # type: ignore[call-overload]
            self._play, fullgraph=True, isolate_recompiles=True, **options
        )
        return self

    def to(self, device: DEVICE_TYPING) -> "UavEnv":
        """Move the worlds and all tables, in place."""
        device = torch.device(device)
        if device == self.device:
            return self
        super().to(device)
        self.simulation.to(device)
        self._first = _map(lambda table: table.to(device), self._first)
        self._worlds = tree_map(lambda t: t.to(device), self._worlds)
        if self._footprints is not None:
            self._footprints = self._footprints.to(device)
        return self

    @property
    def n_agents(self) -> int:
        """N."""
        return self.scenario.agents

    @property
    def state(self) -> State:
        """Everything that changes; assign it to put the worlds into a situation of your own."""
        return self.simulation.layout.unpack(self._worlds)

    @state.setter
    def state(self, state: State) -> None:
        self._worlds = self.simulation.layout.pack(state)

    def seed_worlds(self, seeds: Tensor) -> None:
        """Give every world its own stream, [B] integers; the next reset is its first episode."""
        row = torch.zeros_like(seeds)
        first = tree_map(lambda table: table.index_select(0, row), self.simulation.initial)
        self.state = first._replace(seed=seeds)

    def _set_seed(self, seed: int | None) -> None:
        self.seed_worlds(draws.world_seeds(seed or 0, self.batch_size[0], self.device))

    # TorchRL's hooks.

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._worlds, shown = self._advance(self._worlds, tensordict["agents", "action"])
        return self._tensordict(shown)

    @torch.no_grad()
    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            mask = torch.ones(self.batch_size, dtype=torch.bool, device=self.device)
        self._worlds = self.simulation.reset(self._worlds, mask.view(-1))
        situation = self._worlds.integers[:, SITUATION]
        shown = _map(lambda table: table.index_select(0, situation), self._first)
        return self._tensordict(shown)  # TorchRL keeps what the other worlds showed

    # Pure functions of the state; ``_play`` compiles.

    def _play(self, worlds: Rows, action: Tensor) -> tuple[Rows, Shown]:
        """One step: physics, then what the server makes of the messages."""
        scenario, layout = self.scenario, self.simulation.layout
        state = self.simulation.step(layout.unpack(worlds), action)
        ended = status(
            state.sent,
            state.steps,
            state.steps * self.simulation.dt,
            state.source_over,
            self.simulation.dt,
            scenario.episode,
        )
        features = self._features(state)
        counters = Counters(state.steps, state.sent.motions)
        terms = reward(features, counters, scenario.task)
        total = final_reward(ended, counters, scenario.task)
        total = sum(terms.values(), start=total.unsqueeze(-1).expand_as(state.track))
        shown = self._show(state, features)
        shown["agents"]["reward"] = total.unsqueeze(-1)
        if "reward_terms" in self.extras:
            shown["agents"]["reward_terms"] = terms
        return layout.pack(state), shown | {
            "success": ended.success.unsqueeze(-1),
            "done": (ended.terminated | ended.truncated).unsqueeze(-1),
            "terminated": ended.terminated.unsqueeze(-1),
            "truncated": ended.truncated.unsqueeze(-1),
        }

    def _features(self, state: State) -> dict[str, Tensor]:
        airspace = self.simulation.airspace
        server = Server(
            now=state.steps * self.simulation.dt,
            scale=rows(airspace.scale, state.region),
            time_scale=self.scenario.time_scale,
            battery=self.scenario.battery,
            footprints=self._footprints,
            points=self.simulation.points,
        )
        return observe(state.sent, server, self._wanted)

    def _show(self, state: State, features: dict[str, Tensor]) -> Shown:
        """What is shown of a state, at a reset as after a step; terms and success have not come yet."""
        observation = self.scenario.observation
        agents: Shown = {
            "observation": stack(features, observation.actor),
            "global_observation": stack(features, observation.critic),
            "ready": self.simulation.ready(state),
        }
        if self.scenario.actions.kind == "discrete" and self.scenario.actions.mask:
            agents["action_mask"] = self.simulation.action_mask(state)
        if "reward_terms" in self.extras:
            zero = torch.zeros_like(state.track)
            agents["reward_terms"] = dict.fromkeys(self.scenario.task.terms, zero)
        if "message" in self.extras:
            agents |= {"message": state.sent._asdict(), "talks": state.talks}
        shown = {"agents": agents, **_nothing_yet(state)}
        if "state" in self.extras:
            truth = [state.position.flatten(1), state.battery, state.source]
            shown["state"] = torch.cat(truth, -1)
        return shown

    # Keys and specs.

    def _tensordict(self, shown: Shown) -> TensorDict:
        agents = shown.pop("agents")
        shape = (*self.batch_size, self.n_agents)
        nested = {
            key: TensorDict(value, shape, device=self.device) if isinstance(value, dict) else value
            for key, value in agents.items()
        }
        shown["agents"] = TensorDict(nested, shape, device=self.device)
        return TensorDict(shown, self.batch_size, device=self.device)

    def _make_specs(self) -> None:
        worlds, agents = self.batch_size, torch.Size((*self.batch_size, self.n_agents))
        shown = {key: value for key, value in self._first.items() if key not in _DONE}
        self.observation_spec = _spec_of(shown, worlds, self.device, self.n_agents)
        config = self.scenario.actions
        if config.kind == "discrete":
            action = Categorical(config.n_actions, shape=agents, device=self.device)
        else:
            action = Bounded(0.0, 1.0, shape=torch.Size((*agents, 2)), device=self.device)
        reward = Unbounded(torch.Size((*agents, 1)), device=self.device)
        self.action_spec = Composite(
            agents=Composite(action=action, shape=agents), shape=worlds, device=self.device
        )
        self.reward_spec = Composite(
            agents=Composite(reward=reward, shape=agents), shape=worlds, device=self.device
        )
        ends = {key: self._first[key] for key in _DONE}
        self.done_spec = _spec_of(ends, worlds, self.device, self.n_agents)

    def _build_footprints(self) -> FootprintTables:
        airspace = self.simulation.airspace
        polygons = [region.polygon for region in airspace.regions]
        places = airspace.points.double().numpy()
        return build_tables(polygons, places, self.simulation.radius)


_DONE = ("done", "terminated", "truncated")

_INDUCTOR: dict[str, Any] = {
    # Innermost loops run over a few UAVs: vectors of 16 lanes would be mostly idle, and slower.
    "cpp.simdlen": 1,
    # Shapes may change, the scenario never does: checking it takes as long as a kernel.
    "guard_filter_fn": torch.compiler.keep_tensor_guards_unsafe,
}


def _nothing_yet(state: State) -> Shown:
    """No end and no success at the beginning of an episode."""
    return {key: torch.zeros_like(state.source_over).unsqueeze(-1) for key in (*_DONE, "success")}


def _map(function: Callable[[Tensor], Tensor], shown: Shown) -> Shown:
    """Apply a function to the tensors of nested dictionaries."""
    return {
        key: _map(function, value) if isinstance(value, dict) else function(value)
        for key, value in shown.items()
    }


def _spec_of(shown: Shown, worlds: torch.Size, device: torch.device, n_agents: int) -> Composite:
    """Specs of what is shown, read off an example with any number of worlds."""

    def leaf(name: str, example: Tensor) -> TensorSpec:
        shape = torch.Size((*worlds, *example.shape[1:]))
        if example.dtype == torch.bool:
            return Binary(shape[-1], shape=shape, dtype=torch.bool, device=device)
        if name in ("observation", "global_observation"):
            return Bounded(0.0, 1.0, shape=shape, dtype=example.dtype, device=device)
        return Unbounded(shape, dtype=example.dtype, device=device)

    def branch(level: Shown, shape: torch.Size) -> Composite:
        inner = torch.Size((*worlds, n_agents))
        specs = {
            name: branch(value, inner) if isinstance(value, dict) else leaf(name, value)
            for name, value in level.items()
        }
        return Composite(specs, shape=shape, device=device)

    return branch(shown, worlds)
