"""The server node of one fleet whose messages are reported from outside, instead of sent by a simulation.

It consists of the transforms that follow the delay in ``damian.envs.pipeline``, so that a policy observes the
same, bit for bit, as in the simulation, if the same messages arrive at the same steps.
"""

from dataclasses import replace
from typing import NamedTuple, cast

import torch
from torch import Tensor
from torchrl.envs import Compose

from damian import keys
from damian.common import checks
from damian.common.tensors import tree_map
from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import observation_transforms, remembering_transforms, uplink_transform
from damian.envs.scenario import ScenarioConfig
from damian.envs.uav_env import Outputs, UavEnv
from damian.server.server import Features
from damian.transforms import ServerNode
from damian.transforms.base import StatefulTransform
from damian.transforms.belief import Belief
from damian.transforms.entries import Memory, drop_keys
from damian.transforms.message_history import MessageHistory
from damian.world.state import State

REMEMBERED_STEPS = 32
"""Steps that the belief looks back at least: real messages may be later than those of the training."""
FOREVER = 2**31
"""Steps since the latest decision of a UAV that is ready to choose."""

Memories = list[Memory]
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

    held: Tensor
    """The packed message of each UAV that the server holds, [N, M]."""
    age: Tensor
    """Age of these messages [steps], [N]."""
    on_time: Tensor
    """Which of them arrived in the step in which they were sent, [N] bool."""
    late: list[LateMessage]
    """Messages that arrived in this step, and were sent in earlier ones."""


class ReportedEnv(UavEnv):
    """Regions, landing points, server and specs of a single world, whose messages are reported from outside.

    Nobody steps it; ``Node`` steps the transforms behind it.

    Args:
        scenario: all settings; its delays are not simulated.
        seed: of the region, if the region is random.
        reward_terms: whether a transform writes the weighted terms of the reward.
    """

    def __init__(self, scenario: ScenarioConfig, seed: int = 0, reward_terms: bool = False) -> None:
        extras = {"message", "reward_terms"} if reward_terms else {"message"}
        super().__init__(scenario, 1, seed, extras=extras, messages_only=True)

    def _outputs_at_reset(self, initial: State, features: Features) -> Outputs:
        outputs = super()._outputs_at_reset(initial, features)
        message = outputs[keys.MESSAGE]
        age = torch.zeros_like(message[..., :1])
        return outputs | {keys.RECEIVED: message.clone(), keys.AGE: age, keys.DELAY: age.long()}

    def outputs_of(self, state: State, reported: Reported) -> Outputs:
        """What a step outputs before any transform.

        Args:
            state: of the world, [1, N]; its ``sent`` are the messages that the server holds.
            reported: what the server learns in this step.
        """
        held, on_time = reported.held.unsqueeze(0), reported.on_time.unsqueeze(0)
        every = torch.ones_like(on_time)
        return self._state_outputs(state) | {
            keys.READY: every,
            keys.MESSAGE: held,
            keys.MESSAGE_SENT: on_time,
            keys.RECEIVED: held.clone(),
            keys.AGE: reported.age.view(1, -1, 1).float(),
            keys.DELAY: torch.where(on_time, 0, -1).unsqueeze(-1),
        }

    def first_outputs(self, state: State, reported: Reported) -> Outputs:
        """The same at the beginning, when the server knows the first message of every UAV."""
        features = self.server.features(state.sent, state.steps)
        return self._outputs_at_reset(state, features) | self.outputs_of(state, reported)


class Node:
    """The server node of a fleet: what it remembers, and what it tells the UAVs in each step.

    Args:
        scenario: settings of the training; its number of UAVs is that of the fleet.
        seed: of the region, if the region is random.
        reward_terms: compute the weighted terms of the reward too.

    Raises:
        InputError: the scenario lets UAVs compute observations that the server cannot know.
    """

    def __init__(self, scenario: ScenarioConfig, seed: int = 0, reward_terms: bool = False) -> None:
        scenario = served(scenario)
        self.worlds = ReportedEnv(scenario, seed, reward_terms)
        self.scenario, self.dt = scenario, scenario.clock.dt
        self.server, self.simulation = self.worlds.server, self.worlds.simulation
        longest = uplink_transform(scenario, False, reads_delay=False).sampler.longest
        self.law_longest, self.longest = longest, max(longest, REMEMBERED_STEPS)
        transforms = [
            *remembering_transforms(scenario, self.server, self.longest, delayed=True),
            ServerNode(self.server, reward_terms=reward_terms),
            *observation_transforms(scenario),
        ]
        self.env = DelayedEnv(self.worlds, Compose(*transforms))  # type: ignore[arg-type]
        self.env.reset()  # allocates the memories of the transforms
        self.transforms = cast(list[StatefulTransform], transforms)
        self.blank = tree_map(lambda table: table[:1].clone(), self.simulation.initial)

    def begin(self, state: State, reported: Reported) -> tuple[Memories, Outputs]:
        """The memories and the outputs of the first step.

        Args:
            state: of the world, [1, N]; ``steps`` is the number of the step.
            reported: the first message of every UAV.
        """
        outputs, memories = self.worlds.first_outputs(state, reported), []
        for transform in self.transforms:
            every = transform.expand_worlds(torch.ones(1, dtype=torch.bool))
            memory, changed = transform.on_reset(_copied(transform), outputs, every)
            if isinstance(transform, ServerNode):
                memory["elapsed"] = state.steps.clone()
            memories.append(memory)
            outputs = drop_keys(outputs | changed, transform.dropped_keys)
        return memories, outputs

    def step(
        self, memories: Memories, state: State, reported: Reported, action: Tensor, chosen: Tensor
    ) -> tuple[Memories, Outputs]:
        """The memories and the outputs of a further step; the given memories stay as they are.

        Args:
            memories: after the step before.
            state: of the world, [1, N].
            reported: what the server learns in this step.
            action: actions of the step before, [1, N, ...].
            chosen: which UAVs chose one in the step before, [1, N] bool.
        """
        memories = [{name: value.clone() for name, value in memory.items()} for memory in memories]
        entries: Outputs = {keys.ACTION: action, keys.READY: chosen}
        for i, transform in reversed(list(enumerate(self.transforms))):
            memories[i], changed = transform.on_action(memories[i], entries)
            entries = entries | changed
        outputs = self.worlds.outputs_of(state, reported)
        for i, transform in enumerate(self.transforms):
            if isinstance(transform, Belief | MessageHistory):
                for late in reported.late:
                    memories[i] = transform.note_late(memories[i], *late)
            memories[i], changed = transform.on_step(memories[i], outputs)
            outputs = drop_keys(outputs | changed, transform.dropped_keys)
        return memories, outputs

    def skip(self, memories: Memories, n_steps: int) -> Memories:
        """The memories after steps in which nothing was reported and nobody chose; beliefs stay the same."""
        pairs = zip(self.transforms, memories, strict=True)
        return [transform.after_idle_steps(memory, n_steps) for transform, memory in pairs]


def served(scenario: ScenarioConfig) -> ScenarioConfig:
    """The scenario as a server node outside the simulation can serve it.

    A UAV's own messages are known as late as all others (``observation.own``), and no step is skipped.

    Raises:
        InputError: observations do not come from a server node.
    """
    problem = "is not server: the service is the server node, and cannot know what links bring to a UAV"
    checks.require(scenario.links.kind == "server", "links", scenario.links.kind, problem)
    return replace(
        scenario,
        observation=replace(scenario.observation, own=False),
        clock=replace(scenario.clock, skip=False, skip_discount=1.0),
    )


def for_uavs(scenario: ScenarioConfig, n_uavs: int) -> ScenarioConfig:
    """The scenario of a fleet of another number of UAVs, which begin where they report to be."""
    region = replace(scenario.region, start_positions=None, start_together=False)
    return replace(scenario, agents=n_uavs, region=region)


def _copied(transform: StatefulTransform) -> Memory:
    return {name: value.clone() for name, value in transform.memory.items()}
