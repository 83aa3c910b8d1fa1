"""The server node of a fleet whose messages are reported from outside, instead of sent by a
simulation.

It takes steps as an environment does. So a policy observes the same, bit for bit, as in the
simulation, if the same messages arrive at the same steps.
"""

from dataclasses import replace
from typing import Any, NamedTuple, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose

from damian import keys
from damian.common.errors import InputError
from damian.common.tensors import tree_map
from damian.envs.config import ScenarioConfig
from damian.envs.delayed_env import DelayedEnv
from damian.envs.nodes import Belief, ServerNode
from damian.envs.pipeline import observation_transforms, remembering_transforms
from damian.envs.uav_env import Outputs, UavEnv
from damian.server.belief import report_rows
from damian.server.server import Features
from damian.transforms import ObservationTimeline, StatefulTransform
from damian.transforms.entries import Entries
from damian.world.state import PackedState, State
from damian_fleet.known import Ground

REMEMBERED_STEPS = 32
"""Steps that the belief looks back at least: real messages may be later than those of the
training."""

Memories = list[dict[str, Tensor]]
"""The memory of each transform, in order."""


class LateMessage(NamedTuple):
    """A message that arrives in a later step than that in which it was sent."""

    row: Tensor
    """The packed message, [M]."""
    uav: int
    """Number of its UAV."""
    lag: int
    """Steps from when it was sent until it arrived, at least 1."""


class Reported(NamedTuple):
    """What the server node of N UAVs learns in a step."""

    state: State
    """The world as far as it is known, [1, N]; its ``sent`` are the messages that the server
    holds."""
    age: Tensor
    """Age of these messages [steps], [N]."""
    on_time: Tensor
    """Which of them arrived in the step in which they were sent, [N] bool."""
    late: list[LateMessage]
    """Messages that arrived in this step, and were sent in earlier ones."""


class ReportedEnv(UavEnv):
    """A single world that is known only by its messages; ``Node`` takes its steps."""

    def __init__(self, scenario: ScenarioConfig, seed: int = 0, reward_terms: bool = False) -> None:
        told = {
            "source.count": scenario.source.count == 1,
            "requests.rate": not scenario.requests.slots,
            "actions.command": not scenario.tells_commands,
        }
        for key, is_told in told.items():
            if not is_told:
                raise InputError(
                    f"{key}: it is not told by reports, which know one source, no requests, and "
                    "no commands under way"
                )
        extras = {"message", "reward_terms"} if reward_terms else {"message"}
        super().__init__(scenario, 1, seed, extras=extras, messages_only=True)

    def _outputs_at_reset(self, initial: State, features: Features) -> Outputs:
        outputs = super()._outputs_at_reset(initial, features)
        message = outputs[keys.MESSAGE]
        age = torch.zeros_like(message[..., :1])
        return outputs | {keys.RECEIVED: message.clone(), keys.AGE: age, keys.DELAY: age.long()}

    def step_fn(
        self,
        worlds: Any,
        action: Tensor,
        valid: Tensor | None = None,
        command: Tensor | None = None,
    ) -> tuple[Any, Outputs]:
        """The outputs after a step, of what is ``Reported`` instead of the worlds of a
        simulation."""
        return worlds, self.outputs_of(worlds)

    def reset_fn(self, worlds: Any, mask: Tensor) -> tuple[Any, Outputs]:
        """The outputs of the step that begins an episode; of worlds, before there are any
        reports."""
        if isinstance(worlds, PackedState):
            return super().reset_fn(worlds, mask)
        return worlds, self.outputs_of(worlds, first=True)

    def outputs_of(self, reported: Reported, first: bool = False) -> Outputs:
        """The outputs of a step, before any transform; ``first``: of the step that begins an
        episode."""
        state = reported.state
        on_time = reported.on_time.unsqueeze(0)
        held = state.sent.pack()
        if first:
            outputs = self._outputs_at_reset(state, self.server.features(state.sent, state.steps))
        else:
            outputs = self._state_outputs(state)
        return outputs | {
            keys.READY: torch.ones_like(on_time),
            keys.MESSAGE: held,
            keys.MESSAGE_SENT: on_time,
            keys.RECEIVED: held.clone(),
            keys.AGE: reported.age.view(1, -1, 1).float(),
            keys.DELAY: torch.where(on_time | first, 0, -1).unsqueeze(-1),
        }


class Node:
    """The server node of a fleet; several may share it, because memories are arguments and
    results."""

    def __init__(self, scenario: ScenarioConfig, seed: int = 0, reward_terms: bool = False) -> None:
        scenario = scenario_of_reports(scenario)
        self.worlds = ReportedEnv(scenario, seed, reward_terms)
        self.scenario = scenario
        self.dt = scenario.clock.dt
        self.server = self.worlds.server
        self.simulation = self.worlds.simulation
        delays = scenario.make_delays()
        self.law_longest = delays.obs.longest
        longest = max(self.law_longest, REMEMBERED_STEPS)
        transforms = [
            *remembering_transforms(scenario, self.server, longest, delayed=True),
            ServerNode(self.server, reward_terms=reward_terms),
            *observation_transforms(scenario, delays),
        ]
        self.env = DelayedEnv(self.worlds, Compose(*transforms))  # type: ignore[arg-type]
        """The environment for which the policy is built; nobody steps it."""
        self.env.reset()
        self.ground = Ground(self.simulation.airspace, 2 * scenario.region.lattice_step + 50.0)
        self.transforms = cast(list[StatefulTransform], transforms)
        self._unused = [transform.memory for transform in self.transforms]
        self.blank = tree_map(lambda table: table[:1].clone(), self.simulation.initial)

    @torch.no_grad()
    def begin(self, reported: Reported) -> tuple[Memories, TensorDictBase]:
        """Memories and outputs of the first step, of any number, when every UAV has sent a
        message."""
        everywhere = torch.ones(1, dtype=torch.bool)
        _, memories, outputs = self.env.reset_fn(
            cast(Any, reported), _copies(self._unused), everywhere
        )
        for transform, memory in zip(self.transforms, memories, strict=True):
            if isinstance(transform, ServerNode):
                memory["elapsed"] = reported.state.steps.clone()
        return memories, self.worlds.to_tensordict(outputs)

    @torch.no_grad()
    def step(
        self, memories: Memories, reported: Reported, action: Tensor, chosen: Tensor
    ) -> tuple[Memories, TensorDictBase]:
        """Memories and outputs after actions [1, N, ...] that the ``chosen`` UAVs took in the step
        before."""
        memories = _copies(memories)
        for transform, memory in zip(self.transforms, memories, strict=True):
            for late in reported.late:
                note_late(transform, memory, *late)
        entries: Entries = {keys.ACTION: action, keys.READY: chosen}
        _, memories, outputs = self.env.step_fn(cast(Any, reported), memories, entries)
        return memories, self.worlds.to_tensordict(outputs)


def _copies(memories: Memories) -> Memories:
    """Copies of memories, which steps may change in place."""
    return [{name: value.clone() for name, value in memory.items()} for memory in memories]


def note_late(
    transform: StatefulTransform, memory: dict[str, Tensor], message: Tensor, agent: int, lag: int
) -> None:
    """Note an agent's packed message [M] that arrives in the next step, ``lag`` >= 1 steps late.

    Of a single world; the memory is changed in place.
    """
    if isinstance(transform, ObservationTimeline):
        ages = [0] if transform.ages is None else transform.ages(message).flatten().tolist()
        facts = transform.encoded(message).view(len(ages), -1)
        for fact, age in zip(facts, ages, strict=True):
            slot = age + lag - 1  # of the step before the next one
            if age >= 0 and slot < transform.slots:
                memory["kept"][agent, slot] = fact
                memory["due"][agent, slot].clamp_(max=1)
                memory["sent"][agent, slot] = True
    if isinstance(transform, Belief) and lag <= transform.longest:
        messages = transform.server.messages(message.view(1, 1, -1))
        slot = (memory["slot"] + 1 - lag) % len(memory["report"])
        source = torch.arange(len(slot), device=slot.device)
        level = transform.server.level(messages)
        memory["report"][slot, agent, source] = report_rows(transform.grid, messages, level).view(
            -1
        )
        memory["delay"][slot, agent] = lag


def scenario_of_reports(scenario: ScenarioConfig) -> ScenarioConfig:
    """The scenario as reports tell it: own messages are known as late as others."""
    if scenario.links.kind != "server":
        problem = (
            "is not server: reports are what the server node knows, not what links bring to a UAV"
        )
        raise InputError(f"links: {scenario.links.kind} {problem}")
    if scenario.observation.forward:
        raise InputError("observation.forward: reports are not flown forward: leave it out")
    return replace(scenario, observation=replace(scenario.observation, own=False))


def for_uavs(scenario: ScenarioConfig, n_uavs: int) -> ScenarioConfig:
    """The scenario of a fleet of another number of UAVs, which begin where they report to be."""
    region = replace(scenario.region, start_positions=None, start_together=False)
    return replace(scenario, agents=n_uavs, region=region)
