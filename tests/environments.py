"""Environments of every kind on which the transforms must work, with the keys of their entries."""

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from helpers import square
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, GymEnv

from damian import UavEnv, Uniform


class Kind(NamedTuple):
    """An environment, and the keys of its entries."""

    make: Callable[[], EnvBase]
    observation: Any = ("agents", "observation")
    action: Any = ("agents", "action")
    reward: Any = ("agents", "reward")


class Teams(EnvBase):
    """Two worlds of two agents with flags only in the group, and a state and a team reward at the
    root.

    The state counts the steps of an episode, which lasts 3 or 5 steps; each reward is 1. PettingZoo
    environments with a root state look so.
    """

    def __init__(self):
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
            agents=Composite(
                done=flag,
                terminated=flag.clone(),
                shape=agents,
            ),
            shape=(2,),
        )
        self.reward_spec = Composite(
            agents=Composite(reward=Unbounded((*agents, 1)), shape=agents),
            team_reward=Unbounded((2, 1)),
            shape=(2,),
        )
        self.time = torch.zeros(2)

    def _outputs(self, done):
        agents = {"observation": self.time.view(2, 1, 1).expand(2, 2, 3).clone()}
        flag = done.view(2, 1, 1).expand(2, 2, 1)
        agents |= {"done": flag.clone(), "terminated": flag.clone()}
        return TensorDict(
            {
                "agents": TensorDict(agents, [2, 2]),
                "state": self.time.view(2, 1).clone(),
            },
            [2],
        )

    def _reset(self, tensordict=None, **_):
        mask = None if tensordict is None else tensordict.get(("agents", "_reset"), None)
        mask = torch.ones(2, dtype=torch.bool) if mask is None else mask.flatten(1).any(-1)
        self.time = self.time.masked_fill(mask, 0)
        return self._outputs(torch.zeros(2, dtype=torch.bool))

    def _step(self, tensordict):
        self.time = self.time + 1
        outputs = self._outputs(self.time >= torch.tensor([3, 5]))
        outputs["agents", "reward"] = torch.ones(2, 2, 1)
        return outputs.set("team_reward", torch.ones(2, 1))

    def _set_seed(self, seed):
        """The environment has no randomness."""


def vmas(num_envs=2, n_agents=2, max_steps=4, **options):
    """A multi-agent environment of VMAS: the first two numbers of an observation are the agent's
    position."""
    pytest.importorskip("vmas")
    from torchrl.envs.libs.vmas import VmasEnv  # noqa: PLC0415

    sizes = {"num_envs": num_envs, "n_agents": n_agents, "max_steps": max_steps}
    return VmasEnv("navigation", seed=0, **sizes, **options)


def petting_zoo(n_agents=2):
    """A PettingZoo environment without batch dimensions, with a state at the root and flags in the
    group."""
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
    "UAVs": Kind(
        lambda: UavEnv(
            square(),
            num_worlds=2,
            extras=["message"],
        )
    ),
}


LATE = Uniform(1, 3)
ACTION = ("agents", "action")
OBSERVATION = ("agents", "observation")
REWARD = ("agents", "reward")


class Drift(EnvBase):
    """Three worlds with a moving point each, which the action pushes; their episodes last 3, 4 and
    5 steps."""

    def __init__(self):
        super().__init__(batch_size=torch.Size([3]))
        self.observation_spec = Composite(observation=Unbounded((3, 2)), shape=(3,))
        self.action_spec = Bounded(-1.0, 1.0, (3, 2))
        self.reward_spec = Unbounded((3, 1))
        self.place = torch.zeros(3, 2)
        self.time = torch.zeros(3)

    def _reset(self, tensordict=None):
        reset = torch.ones(3, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict:
            reset = tensordict["_reset"].view(3)
        self.place = torch.where(reset.unsqueeze(-1), torch.arange(6.0).view(3, 2), self.place)
        self.time = self.time.masked_fill(reset, 0)
        return TensorDict({"observation": self.place}, [3])

    def _step(self, tensordict):
        self.place = 0.9 * self.place + tensordict["action"]
        self.time = self.time + 1
        done = (self.time >= torch.tensor([3, 4, 5])).unsqueeze(-1)
        outputs = {
            "observation": self.place,
            "reward": self.place.sum(-1, keepdim=True),
            "done": done,
            "terminated": done,
        }
        return TensorDict(outputs, [3])

    def _set_seed(self, seed):
        """The environment has no randomness."""


cartpole = KINDS["CartPole"].make
uavs = KINDS["UAVs"].make


def unserved():
    """As ``uavs``, but without a server node."""
    return UavEnv(square(), num_worlds=2, extras=["message"], messages_only=True)
