"""The server node of a fleet whose messages are reported from outside, instead of sent by a simulation.

Its environment has the transforms that follow the delay in ``damian.envs.pipeline``, and takes its steps as
any other one. So a policy observes the same, bit for bit, as in the simulation, if the same messages arrive
at the same steps.
"""

from dataclasses import replace
from typing import NamedTuple, cast

import torch
from tensordict import TensorDict, TensorDictBase
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
from damian.transforms import Belief, MessageHistory, ServerNode, StatefulTransform
from damian.world.state import PackedState, State

REMEMBERED_STEPS = 32
"""Steps that the belief looks back at least: real messages may be later than those of the training."""

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
    """The world as far as it is known, [1, N]; its ``sent`` are the messages that the server holds."""
    age: Tensor
    """Age of these messages [steps], [N]."""
    on_time: Tensor
    """Which of them arrived in the step in which they were sent, [N] bool."""
    late: list[LateMessage]
    """Messages that arrived in this step, and were sent in earlier ones."""


class ReportedEnv(UavEnv):
    """A single world that is, after every step, as UAVs have reported it.

    Args:
        scenario: all settings; its delays are not simulated.
        seed: of the region, if the region is random.
        reward_terms: whether a transform writes the weighted terms of the reward.
    """

    reported: Reported | None = None
    """What the next step or reset brings; assign it before."""

    def __init__(self, scenario: ScenarioConfig, seed: int = 0, reward_terms: bool = False) -> None:
        extras = {"message", "reward_terms"} if reward_terms else {"message"}
        super().__init__(scenario, 1, seed, extras=extras, messages_only=True)

    def step_fn(
        self, worlds: PackedState, action: Tensor, valid: Tensor | None = None
    ) -> tuple[PackedState, Outputs]:
        assert self.reported is not None
        return worlds, self._outputs_of(self.reported)

    def reset_fn(self, worlds: PackedState, mask: Tensor) -> tuple[PackedState, Outputs]:
        if self.reported is None:  # the first reset, which allocates the memories of the transforms
            return super().reset_fn(worlds, mask)
        state = self.reported.state
        outputs = self._outputs_at_reset(state, self.server.features(state.sent, state.steps))
        return worlds, outputs | self._outputs_of(self.reported)

    def _outputs_at_reset(self, initial: State, features: Features) -> Outputs:
        outputs = super()._outputs_at_reset(initial, features)
        message = outputs[keys.MESSAGE]
        age = torch.zeros_like(message[..., :1])
        return outputs | {keys.RECEIVED: message.clone(), keys.AGE: age, keys.DELAY: age.long()}

    def _outputs_of(self, reported: Reported) -> Outputs:
        """What a step outputs before any transform."""
        held, on_time = reported.state.sent.pack(), reported.on_time.unsqueeze(0)
        return self._state_outputs(reported.state) | {
            keys.READY: torch.ones_like(on_time),
            keys.MESSAGE: held,
            keys.MESSAGE_SENT: on_time,
            keys.RECEIVED: held.clone(),
            keys.AGE: reported.age.view(1, -1, 1).float(),
            keys.DELAY: torch.where(on_time, 0, -1).unsqueeze(-1),
        }


class Node:
    """The server node of a fleet: what it remembers, and what it tells the UAVs in each step.

    Several fleets may share a node, because their memories are arguments and results of its methods.

    Args:
        scenario: settings of the training; its number of UAVs is that of the fleet.
        seed: of the region, if the region is random.
        reward_terms: compute the weighted terms of the reward too.

    Raises:
        InputError: the scenario lets UAVs compute observations that the server cannot know.
    """

    def __init__(self, scenario: ScenarioConfig, seed: int = 0, reward_terms: bool = False) -> None:
        scenario = scenario_of_service(scenario)
        self.worlds = ReportedEnv(scenario, seed, reward_terms)
        self.scenario, self.dt = scenario, scenario.clock.dt
        self.server, self.simulation = self.worlds.server, self.worlds.simulation
        self.law_longest = uplink_transform(scenario, False, reads_delay=False).sampler.longest
        longest = max(self.law_longest, REMEMBERED_STEPS)
        transforms = [
            *remembering_transforms(scenario, self.server, longest, delayed=True),
            ServerNode(self.server, reward_terms=reward_terms),
            *observation_transforms(scenario),
        ]
        self.env = DelayedEnv(self.worlds, Compose(*transforms))  # type: ignore[arg-type]
        self.env.reset()
        self.transforms = cast(list[StatefulTransform], transforms)
        self._unused = self._memories()
        self.blank = tree_map(lambda table: table[:1].clone(), self.simulation.initial)

    def begin(self, reported: Reported) -> tuple[Memories, TensorDictBase]:
        """The memories and the outputs of the first step, in which the first message of every UAV is known.

        The number of the step is in ``reported.state``, and need not be 0.
        """
        self._remember(self._unused)
        self.worlds.reported = reported
        outputs = self.env.reset()
        for transform in self.transforms:
            if isinstance(transform, ServerNode):
                transform.set_memory({"elapsed": reported.state.steps.clone()})
        return self._memories(), outputs

    def step(
        self, memories: Memories, reported: Reported, action: Tensor, chosen: Tensor
    ) -> tuple[Memories, TensorDictBase]:
        """The memories and the outputs of a further step; the given memories stay as they are.

        Args:
            memories: after the step before.
            reported: what the server learns in this step.
            action: actions of the step before, [1, N, ...].
            chosen: which UAVs chose one in the step before, [1, N] bool.
        """
        self._remember(memories)
        for transform in self.transforms:
            if isinstance(transform, Belief | MessageHistory):
                for late in reported.late:
                    transform.set_memory(transform.note_late(transform.memory, *late))
        self.worlds.reported = reported
        agents = TensorDict({keys.ACTION[-1]: action, keys.READY[-1]: chosen}, chosen.shape)
        outputs = self.env.step(TensorDict({keys.AGENTS: agents}, chosen.shape[:1]))["next"]
        return self._memories(), outputs

    def skip(self, memories: Memories, n_steps: int) -> Memories:
        """The memories after steps in which nothing was reported and nobody chose; beliefs stay the same."""
        pairs = zip(self.transforms, memories, strict=True)
        return [transform.after_idle_steps(memory, n_steps) for transform, memory in pairs]

    def _remember(self, memories: Memories) -> None:
        """Give the transforms copies of memories, which steps may change in place."""
        for transform, memory in zip(self.transforms, memories, strict=True):
            transform.set_memory({name: value.clone() for name, value in memory.items()})

    def _memories(self) -> Memories:
        return [transform.memory for transform in self.transforms]


def scenario_of_service(scenario: ScenarioConfig) -> ScenarioConfig:
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
