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

from damian.common import counter_rng
from damian.common.compiling import compiled
from damian.envs.scenario import ScenarioConfig
from damian.server.server import Features, Server
from damian.world.airspace import rows
from damian.world.simulation import Simulation
from damian.world.state import SITUATION, Rows, State, tree_map

Shown = dict[str, Any]
"""What a step shows, as nested dictionaries of tensors."""

EXTRAS = ("message", "state", "reward_terms")
PRIVILEGED = "privileged_observation"


class UavEnv(EnvBase):
    """B worlds in which N UAVs search for, track and cover things.

    Nothing is delayed here: whatever ``scenario.delay`` and the slower clocks of ``scenario.clock`` say is
    the business of transforms (``damian.delayed.make_env`` puts them together).

    Batch size ``[B]``. What belongs to the UAVs stands under ``"agents"``, batch size ``[B, N]``:

    - ``action``: discrete [B, N], or continuous [B, N, 2] in [0, 1] (SPEC 2);
    - ``action_mask``: discrete actions that would do something, [B, N, A] (if ``actions.mask``);
    - ``ready``: may the UAV choose now, [B, N];
    - ``observation``, ``global_observation``: features of the actor [B, N, F], of the critic [B, N, G];
    - ``message``: the latest message of each UAV, [B, N, M] (``Snapshot.unpack`` names its numbers), and
      ``talks``: sent just now, [B, N];
    - ``privileged_observation``: ``global_observation`` as if nothing were late or lost, and how far east and
      north of the UAV the source really is, over the region's size, in [-1, 1] each; [B, N, G + 2];
    - ``reward``: eq. 8, [B, N, 1]; ``reward_terms``: its weighted terms by name, [B, N].

    At the root stand ``state`` (simulator truth: for drawing and reference arms, never for an actor),
    ``success``, and TorchRL's ``done``, ``terminated``, ``truncated``; with ``episode.end_with_source`` also
    ``source_over``. A step reads, beside the action, the flag ``("agents", "acts")`` [B, N] if there is one:
    an action of a UAV whose flag is false is none, as if it were not ready.

    Args:
        scenario: what a world is made of.
        num_worlds: B.
        seed: of the regions and situations drawn at construction, and of the worlds' streams.
        device: where everything lives.
        extras: which of ``message``, ``state``, ``reward_terms`` and (reference arms only) ``privileged``
            are shown; each costs time, so leave out what nobody reads (delays read the messages).
        serves: False leaves it to a ``ServerNode`` transform to make something of the messages: what it
            writes is empty after a step.

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
        serves: bool = True,
    ) -> None:
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([num_worlds]))
        self.scenario = scenario or ScenarioConfig()
        self.extras = frozenset(extras)
        self.serves = serves
        self.simulation = Simulation(self.scenario, seed)
        self.server = Server(self.scenario, self.simulation.airspace, self.simulation.radius)
        first = self.simulation.initial
        features = self.server.features(first.sent, first.steps)
        self._first = _merged(self._show(first, features), self._nothing_yet(first))
        self._blank = self._empty()
        self._make_specs()
        self.set_seed(seed)
        self._advance = self._advance_some = self.play
        self._restart = self.begin
        self.to(torch.device(device))

    def compile(self, **options: Any) -> "UavEnv":
        """Compile what a step computes, as one graph, in place of TorchRL's bookkeeping around it.

        Args:
            options: for ``torch.compile``, in place of what suits a CPU.
        """
        # Two graphs, as whether there are flags is not checked by what is kept of the guards.
        self._advance = compiled(self.play, **options)
        self._advance_some = compiled(self.play, **options)
        self._restart = compiled(self.begin, **options)
        return self

    def to(self, device: DEVICE_TYPING) -> "UavEnv":
        """Move the worlds and all tables, in place."""
        device = torch.device(device)
        if device == self.device:
            return self
        super().to(device)
        self.simulation.to(device)
        self._first, self._blank = (
            _map(lambda table: table.to(device), shown) for shown in (self._first, self._blank)
        )
        self.worlds = tree_map(lambda t: t.to(device), self.worlds)
        self.server.to(device)
        return self

    @property
    def n_agents(self) -> int:
        """N."""
        return self.scenario.agents

    @property
    def state(self) -> State:
        """Everything that changes; assign it to put the worlds into a situation of your own."""
        return self.simulation.layout.unpack(self.worlds)

    @state.setter
    def state(self, state: State) -> None:
        self.worlds = self.simulation.layout.pack(state)

    def seed_worlds(self, seeds: Tensor) -> None:
        """Give every world its own stream, [B] integers; the next reset is its first episode."""
        row = torch.zeros_like(seeds)
        first = tree_map(lambda table: table.index_select(0, row), self.simulation.initial)
        self.state = first._replace(seed=seeds)

    def _set_seed(self, seed: int | None) -> None:
        self.seed_worlds(counter_rng.world_seeds(seed or 0, self.batch_size[0], self.device))

    # TorchRL's hooks.

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        agents = tensordict.get("agents")
        action, acts = agents.get("action"), agents.get("acts", None)
        if acts is None:
            self.worlds, shown = self._advance(self.worlds, action)
        else:
            self.worlds, shown = self._advance_some(self.worlds, action, acts)
        return self.tensordict(shown)

    @torch.no_grad()
    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            mask = torch.ones(self.batch_size, dtype=torch.bool, device=self.device)
        self.worlds, shown = self._restart(self.worlds, mask.view(-1))
        return self.tensordict(shown)  # TorchRL keeps what the other worlds showed

    # Pure functions of the state; ``play`` and ``begin`` compile.

    def begin(self, worlds: Rows, mask: Tensor) -> tuple[Rows, Shown]:
        """New episodes in the worlds of the mask [B], and what each world begins with."""
        if torch.compiler.is_compiling():  # no shapes that depend on data
            fresh = self.simulation.next_episode(worlds)
            worlds = tree_map(lambda new, old: torch.where(mask.unsqueeze(-1), new, old), fresh, worlds)
        else:
            worlds = self.simulation.reset(worlds, mask)
        situation = worlds.integers[:, SITUATION]
        return worlds, _map(lambda table: table.index_select(0, situation), self._first)

    def play(self, worlds: Rows, action: Tensor, acts: Tensor | None = None) -> tuple[Rows, Shown]:
        """One step: physics, then what the server makes of the messages."""
        state = self.simulation.step(self.simulation.layout.unpack(worlds), action, acts)
        packed = self.simulation.layout.pack(state)
        if not self.serves:
            return packed, _merged(self._show(state), self._blank)
        features = self.server.features(state.sent, state.steps)
        shown = self._show(state, features)
        total, terms, ended = self.server.judge(features, state.sent, state.steps, state.source_over)
        shown["agents"]["reward"] = total.unsqueeze(-1)
        if "reward_terms" in self.extras:
            shown["agents"]["reward_terms"] = terms
        return packed, shown | ended.entries()

    def _show(self, state: State, features: Features | None = None) -> Shown:
        """What is shown of a state, at a reset as after a step; terms and success have not come yet."""
        agents: Shown = {"ready": self.simulation.ready(state)}
        if features is not None:
            agents["observation"], agents["global_observation"] = self.server.observations(features)
        if self.scenario.actions.kind == "discrete" and self.scenario.actions.mask:
            agents["action_mask"] = self.simulation.action_mask(state)
        if "message" in self.extras:
            agents |= {"message": state.sent.pack(), "talks": state.talks}
        if "privileged" in self.extras:
            agents[PRIVILEGED] = self._truth(state, features)
        shown: Shown = {"agents": agents}
        if self.scenario.episode.end_with_source:
            shown["source_over"] = state.source_over.unsqueeze(-1)
        if "state" in self.extras:
            truth = [state.position.flatten(1), state.battery, state.source]
            shown["state"] = torch.cat(truth, -1)
        return shown

    def _truth(self, state: State, features: Features | None) -> Tensor:
        """What a privileged critic sees, [B, N, G + 2]."""
        _, seen = self.server.observations(features or self.server.features(state.sent, state.steps))
        scale = rows(self.simulation.airspace.scale, state.region).view(-1, 1, 1)
        toward = (state.source.unsqueeze(-2) - state.position[..., :2]) / scale
        return torch.cat([seen, toward.clamp(-1, 1)], -1)

    def _empty(self) -> Shown:
        """In place of what a ``ServerNode`` will make of the messages."""
        made = {key: self._first[key] for key in (*_DONE, "success")}
        names = ("observation", "global_observation", "reward_terms")
        agents = {key: value for key, value in self._first["agents"].items() if key in names}
        agents["reward"] = self._first["agents"]["observation"][..., :1]
        n_worlds = self.batch_size[0]
        return _map(lambda x: x.new_zeros(n_worlds, *x.shape[1:]), made | {"agents": agents})

    def _nothing_yet(self, state: State) -> Shown:
        """Rewards, success and ends before anything has happened; the terms only if they are shown."""
        zero, no = torch.zeros_like(state.track), torch.zeros_like(state.source_over).unsqueeze(-1)
        terms = dict.fromkeys(self.scenario.task.terms, zero)
        agents = {"reward_terms": terms} if "reward_terms" in self.extras else {}
        return {"agents": agents, **dict.fromkeys((*_DONE, "success"), no)}

    # Keys and specs.

    def tensordict(self, shown: Shown) -> TensorDict:
        """What is shown, with batch sizes."""
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


_DONE = ("done", "terminated", "truncated")


def _merged(some: Shown, others: Shown) -> Shown:
    """Both, and both of what stands under ``agents``."""
    return some | others | {"agents": some["agents"] | others["agents"]}


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
        if name in ("observation", "global_observation", PRIVILEGED):
            low = -1.0 if name == PRIVILEGED else 0.0
            return Bounded(low, 1.0, shape=shape, dtype=example.dtype, device=device)
        return Unbounded(shape, dtype=example.dtype, device=device)

    def branch(level: Shown, shape: torch.Size) -> Composite:
        inner = torch.Size((*worlds, n_agents))
        specs = {
            name: branch(value, inner) if isinstance(value, dict) else leaf(name, value)
            for name, value in level.items()
        }
        return Composite(specs, shape=shape, device=device)

    return branch(shown, worlds)
