"""Environments of every kind, and the transforms on them, on which the contract is checked."""

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from helpers import square, walking
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, GymEnv, Transform, TransformedEnv

from damian.delays.laws import Uniform
from damian.envs.nodes import Belief, ServerNode
from damian.envs.uav_env import UavEnv
from damian.server.features import ObservationConfig
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    Channel,
    CumulativeReward,
    ObservationDelay,
    ObservationTimeline,
    RewardDelay,
    SampleAndHold,
    StatefulTransform,
    set_seed,
)


class Kind(NamedTuple):
    """An environment, and the keys of its entries."""

    make: Callable[[], EnvBase]
    observation: Any = ("agents", "observation")
    action: Any = ("agents", "action")
    reward: Any = ("agents", "reward")


class Teams(EnvBase):
    """Two worlds of two agents with flags only in the group, and a state and a team reward at the root.

    The state counts the steps of an episode, which lasts 3 or 5 steps; each reward is 1. PettingZoo
    environments with a root state look so.
    """

    def __init__(self) -> None:
        super().__init__(batch_size=torch.Size([2]))
        agents = torch.Size([2, 2])
        group = {"observation": Unbounded((*agents, 3))}
        self.observation_spec = Composite(
            agents=Composite(**group, shape=agents), state=Unbounded((2, 1)), shape=(2,)
        )
        self.action_spec = Composite(
            agents=Composite(action=Bounded(-1.0, 1.0, (*agents, 2)), shape=agents), shape=(2,)
        )
        flag = Categorical(2, shape=(*agents, 1), dtype=torch.bool)
        self.done_spec = Composite(
            agents=Composite(done=flag, terminated=flag.clone(), shape=agents), shape=(2,)
        )
        self.reward_spec = Composite(
            agents=Composite(reward=Unbounded((*agents, 1)), shape=agents),
            team_reward=Unbounded((2, 1)),
            shape=(2,),
        )
        self.time = torch.zeros(2)

    def _outputs(self, done: torch.Tensor) -> TensorDict:
        agents = {"observation": self.time.view(2, 1, 1).expand(2, 2, 3).clone()}
        flag = done.view(2, 1, 1).expand(2, 2, 1)
        agents |= {"done": flag.clone(), "terminated": flag.clone()}
        return TensorDict({"agents": TensorDict(agents, [2, 2]), "state": self.time.view(2, 1).clone()}, [2])

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get(("agents", "_reset"), None)
        mask = torch.ones(2, dtype=torch.bool) if mask is None else mask.flatten(1).any(-1)
        self.time = self.time.masked_fill(mask, 0)
        return self._outputs(torch.zeros(2, dtype=torch.bool))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.time = self.time + 1
        outputs = self._outputs(self.time >= torch.tensor([3, 5]))
        outputs["agents", "reward"] = torch.ones(2, 2, 1)
        return outputs.set("team_reward", torch.ones(2, 1))

    def _set_seed(self, seed: int | None) -> None:
        """The environment has no randomness."""


def vmas(num_envs: int = 2, n_agents: int = 2, max_steps: int = 4, **options: Any) -> EnvBase:
    """A multi-agent environment of VMAS: the first two numbers of an observation are the agent's position."""
    pytest.importorskip("vmas")
    from torchrl.envs.libs.vmas import VmasEnv  # noqa: PLC0415

    sizes = {"num_envs": num_envs, "n_agents": n_agents, "max_steps": max_steps}
    return VmasEnv("navigation", seed=0, **sizes, **options)


def petting_zoo(n_agents: int = 2) -> EnvBase:
    """A PettingZoo environment without batch dimensions, with a state at the root and flags in the group."""
    spread = pytest.importorskip("mpe2.simple_spread_v3")
    from torchrl.envs.libs.pettingzoo import PettingZooWrapper  # noqa: PLC0415

    options = {"N": n_agents, "max_cycles": 4, "continuous_actions": True}
    return PettingZooWrapper(spread.parallel_env(**options), return_state=True, seed=0)


ROOT = ("observation", "action", "reward")
KINDS = {
    "CartPole": Kind(
        lambda: GymEnv("CartPole-v1", categorical_action_encoding=True, max_episode_steps=4), *ROOT
    ),
    "Pendulum": Kind(lambda: GymEnv("Pendulum-v1", max_episode_steps=4), *ROOT),
    "VMAS": Kind(lambda: vmas(collisions=False)),
    "PettingZoo": Kind(petting_zoo, *(("agent", name) for name in ROOT)),
    "PettingZoo, state": Kind(petting_zoo, "state", ("agent", "action"), ("agent", "reward")),
    "flags in the group": Kind(Teams),
    "flags in the group, root entries": Kind(Teams, "state", ("agents", "action"), "team_reward"),
    "UAVs": Kind(lambda: UavEnv(square(), num_worlds=2, extras=["message"])),
}


LATE = Uniform(1, 3)
ACTION, OBSERVATION, REWARD = ("agents", "action"), ("agents", "observation"), ("agents", "reward")


class Drift(EnvBase):
    """Three worlds with a moving point each, which the action pushes; their episodes last 3, 4 and 5 steps.

    Observation and reward have a gradient with respect to the action of the same step, but not of earlier
    steps.
    """

    def __init__(self) -> None:
        super().__init__(batch_size=torch.Size([3]))
        self.observation_spec = Composite(observation=Unbounded((3, 2)), shape=(3,))
        self.action_spec = Bounded(-1.0, 1.0, (3, 2))
        self.reward_spec = Unbounded((3, 1))
        self._longest = torch.tensor([3, 4, 5])

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        reset = torch.ones(3, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict:
            reset = tensordict["_reset"].view(3)
        first = torch.arange(6.0).view(3, 2)
        if reset.all():
            self.place, self.time = first, torch.zeros(3, dtype=torch.long)
        self.place = torch.where(reset.unsqueeze(-1), first, self.place)
        self.time = self.time.masked_fill(reset, 0)
        return TensorDict({"observation": self.place}, [3])

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        place = 0.9 * self.place + tensordict["action"]
        self.place, self.time = place.detach(), self.time + 1
        done = (self.time >= self._longest).unsqueeze(-1)
        flags = {"done": done, "terminated": done}
        return TensorDict({"observation": place, "reward": place.sum(-1, keepdim=True), **flags}, [3])

    def _set_seed(self, seed: int | None) -> None:
        """The environment has no randomness."""


class Servos(Drift):
    """``Drift``, pushed by the sum of two entries of an action: a place and the index of a gear."""

    def __init__(self) -> None:
        super().__init__()
        self.action_spec = Composite(
            place=Bounded(-1.0, 1.0, (3, 2)), gear=Categorical(5, shape=(3,)), shape=(3,)
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        pushed = tensordict["place"] + tensordict["gear"].unsqueeze(-1)
        return super()._step(TensorDict({"action": pushed}, [3]))


cartpole, uavs = KINDS["CartPole"].make, KINDS["UAVs"].make


def unserved() -> EnvBase:
    """As ``uavs``, but without a server node."""
    return UavEnv(square(), num_worlds=2, extras=["message"], messages_only=True)


class Case(NamedTuple):
    """An environment, and a transform that works on it."""

    env: Callable[[], EnvBase]
    make: Callable[[], Transform]

    def build(self) -> TransformedEnv:
        """The environment with the transform."""
        return TransformedEnv(self.env(), self.make())


def _belief() -> Transform:
    observation = ObservationConfig(belief=["belief_moments"])
    scenario = square(observation=observation, source=walking())
    server = UavEnv(scenario, num_worlds=2, extras=["message"], messages_only=True).server
    return Belief(server, longest=0, delayed=False, own=True)


CASES = {
    "Belief": Case(uavs, _belief),
    "ActionDelay, worlds": Case(Drift, lambda: ActionDelay(LATE, loss=0.2)),
    "ActionDelay, two entries": Case(
        Servos, lambda: ActionDelay(LATE, ["place", "gear"], ["wish", "gear"], loss=0.2)
    ),
    "ActionDelay, agents": Case(uavs, lambda: ActionDelay(LATE, ACTION, sent_key="ready")),
    "ActionHistory, one world": Case(cartpole, lambda: ActionHistory(2, append_to="observation")),
    "ActionHistory, worlds": Case(Drift, lambda: ActionHistory(3)),
    "ActionHistory, agents": Case(
        uavs, lambda: ActionHistory(2, ACTION, append_to=OBSERVATION, recorded_key="ready")
    ),
    "SampleAndHold, worlds": Case(Drift, lambda: SampleAndHold(2, in_keys_inv=["action"])),
    "SampleAndHold, agents": Case(
        uavs, lambda: SampleAndHold("2s", [OBSERVATION], [ACTION], ready_key=("agents", "ready"))
    ),
    "CumulativeReward, worlds": Case(Drift, lambda: CumulativeReward(3)),
    "CumulativeReward, agents": Case(uavs, lambda: CumulativeReward(3, 0.5, REWARD)),
    "ObservationTimeline, one world": Case(cartpole, lambda: ObservationTimeline(3)),
    "ObservationTimeline, worlds": Case(Drift, lambda: ObservationTimeline(2)),
    "ObservationTimeline, agents": Case(
        uavs,
        lambda: ObservationTimeline(3, ("agents", "message"), sent_key="message_sent", group=True, own=True),
    ),
    "ObservationDelay, one world": Case(cartpole, lambda: ObservationDelay(LATE)),
    "ObservationDelay, worlds": Case(Drift, lambda: ObservationDelay({"law": "burst"}, fresh_key="fresh")),
    "ObservationDelay, agents": Case(
        uavs,
        lambda: ObservationDelay(LATE, [OBSERVATION], loss=0.2, delay_key="delay", sent_key="message_sent"),
    ),
    "RewardDelay, one world": Case(cartpole, lambda: RewardDelay(LATE)),
    "RewardDelay, worlds": Case(Drift, lambda: RewardDelay({"law": "geometric"})),
    "RewardDelay, agents": Case(uavs, lambda: RewardDelay(LATE, REWARD)),
    "Channel, links": Case(
        uavs,
        lambda: Channel(
            [[0, LATE, 1], [3, 0, 0], [0, LATE, 0]], OBSERVATION, loss=0.2, limit=2, sent_key="message_sent"
        ),
    ),
    "Channel, messages": Case(uavs, lambda: Channel(LATE, action_key=("agents", "words"), message_size=2)),
    "ServerNode": Case(unserved, lambda: ServerNode(unserved().server, ("agents", "message"))),
}
"""Every transform on every kind of environment that it works on; the name before the comma is its class."""


def onward(env: EnvBase, td: TensorDictBase, n_steps: int = 6, seed: int = 0) -> list[TensorDictBase]:
    """Step with random actions and partial resets; the outputs of every step and every reset."""
    torch.manual_seed(seed)
    outputs = []
    for _ in range(n_steps):
        after, td = env.step_and_maybe_reset(env.rand_action(td))
        outputs += [after["next"].clone(), td.clone()]
    return outputs


def begun(env: EnvBase, n_steps: int = 5, seed: int = 0) -> TensorDictBase:
    """Reset and step an environment; the TensorDict from which ``onward`` can continue."""
    set_seed(env, seed)
    torch.manual_seed(seed)
    td = env.reset()
    return onward(env, td, n_steps, seed)[-1] if n_steps else td


def memory(transform: Transform) -> list[Tensor]:
    """All tensors that a transform remembers."""
    return [value for value in transform.state_dict().values() if value is not None]


# Every transform on every kind of environment.

GROUPS = {name: kind for name, kind in KINDS.items() if isinstance(kind.observation, tuple)}
"""Kinds whose observations are those of a group of agents, for ``Channel``."""


def observation_delay(kind: Kind, law: Any, **options: Any) -> StatefulTransform:
    return ObservationDelay(law, kind.observation, fresh_key="fresh", delay_key="delay", **options)


TRANSFORMS: dict[str, Callable[..., StatefulTransform]] = {
    "ObservationDelay": observation_delay,
    "ActionDelay": lambda kind, law, **options: ActionDelay(law, kind.action, **options),
    "RewardDelay": lambda kind, law, **options: RewardDelay(
        law, kind.reward, delay_key="reward_delay", earned_key="earned_reward", **options
    ),
    "CumulativeReward": lambda kind, law, **options: CumulativeReward(3, 0.5, kind.reward, **options),
    "ActionHistory": lambda kind, law, **options: ActionHistory(3, kind.action, **options),
    "SampleAndHold": lambda kind, law, **options: SampleAndHold(2, kind.observation, **options),
}
every_kind = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


PAIRS = {f"{name} on {kind}": (KINDS[kind], make) for kind in KINDS for name, make in TRANSFORMS.items()} | {
    f"Channel on {name}": (kind, lambda kind, law: Channel(law, kind.observation, loss=0.1))
    for name, kind in GROUPS.items()
}
"""Every kind of environment with every transform, and with a channel where that works."""
DRAWING = {name: pair for name, pair in PAIRS.items() if "Delay" in name or "Channel" in name}
drawing = pytest.mark.parametrize(("kind", "make"), DRAWING.values(), ids=DRAWING)
