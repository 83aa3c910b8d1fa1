"""What the contract of the transforms is checked on: an environment with gradients, and a table of cases."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from helpers import square
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, GymEnv, Transform, TransformedEnv

from damian.envs.uav_env import UavEnv
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    CumulativeReward,
    ObservationDelay,
    RewardDelay,
    SampleAndHold,
    ServerNode,
)

LATE = {"law": "uniform", "low": 1, "high": 3}
ACTION, SEEN, REWARD = ("agents", "action"), ("agents", "observation"), ("agents", "reward")


class Drift(EnvBase):
    """Three points that are pushed about, each by its action; an episode takes 3, 4 and 5 steps.

    A step passes gradients from the action on, but keeps none for the next step.
    """

    def __init__(self) -> None:
        super().__init__(batch_size=torch.Size([3]))
        self.observation_spec = Composite(observation=Unbounded((3, 2)), shape=(3,))
        self.action_spec = Bounded(-1.0, 1.0, (3, 2))
        self.reward_spec = Unbounded((3, 1))
        self._longest = torch.tensor([3, 4, 5])

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        again = torch.ones(3, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict:
            again = tensordict["_reset"].view(3)
        first = torch.arange(6.0).view(3, 2)
        if again.all():
            self.place, self.time = first, torch.zeros(3, dtype=torch.long)
        self.place = torch.where(again.unsqueeze(-1), first, self.place)
        self.time = self.time.masked_fill(again, 0)
        return TensorDict({"observation": self.place}, [3])

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        place = 0.9 * self.place + tensordict["action"]
        self.place, self.time = place.detach(), self.time + 1
        over = (self.time >= self._longest).unsqueeze(-1)
        ends = {"done": over, "terminated": over}
        return TensorDict({"observation": place, "reward": place.sum(-1, keepdim=True), **ends}, [3])

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is drawn."""


def cartpole() -> EnvBase:
    """One world, no batch."""
    return GymEnv("CartPole-v1", categorical_action_encoding=True, max_episode_steps=4)


def uavs() -> EnvBase:
    """Two worlds of three agents, what belongs to them under a nested key."""
    return UavEnv(square(), num_worlds=2, extras=["message"])


def unserved() -> EnvBase:
    """The same, without a server node."""
    return UavEnv(square(), num_worlds=2, extras=["message"], messages_only=True)


class Case(NamedTuple):
    """A transform and an environment that it works on."""

    env: Callable[[], EnvBase]
    make: Callable[[], Transform]

    def build(self) -> TransformedEnv:
        """Both together."""
        return TransformedEnv(self.env(), self.make())


def _served() -> Transform:
    return ServerNode(unserved().server, ("agents", "message"))


CASES = {
    "ActionDelay, one world": Case(cartpole, lambda: ActionDelay(LATE)),
    "ActionDelay, worlds": Case(Drift, lambda: ActionDelay(LATE, loss=0.2)),
    "ActionDelay, agents": Case(uavs, lambda: ActionDelay(LATE, ACTION, sent_key="ready")),
    "ActionHistory, one world": Case(cartpole, lambda: ActionHistory(2, append_to="observation")),
    "ActionHistory, worlds": Case(Drift, lambda: ActionHistory(3)),
    "ActionHistory, agents": Case(
        uavs, lambda: ActionHistory(2, ACTION, append_to=SEEN, recorded_key="ready")
    ),
    "SampleAndHold, one world": Case(cartpole, lambda: SampleAndHold(3)),
    "SampleAndHold, worlds": Case(Drift, lambda: SampleAndHold(2, in_keys_inv=["action"])),
    "SampleAndHold, agents": Case(
        uavs, lambda: SampleAndHold("2s", [SEEN], [ACTION], ready_key=("agents", "ready"))
    ),
    "CumulativeReward, one world": Case(cartpole, lambda: CumulativeReward(3)),
    "CumulativeReward, worlds": Case(Drift, lambda: CumulativeReward(3)),
    "CumulativeReward, agents": Case(uavs, lambda: CumulativeReward(3, 0.5, REWARD)),
    "ObservationDelay, one world": Case(cartpole, lambda: ObservationDelay(LATE)),
    "ObservationDelay, worlds": Case(Drift, lambda: ObservationDelay({"law": "burst"}, fresh_key="fresh")),
    "ObservationDelay, agents": Case(
        uavs, lambda: ObservationDelay(LATE, [SEEN], loss=0.2, delay_key="delay", sent_key="message_sent")
    ),
    "RewardDelay, one world": Case(cartpole, lambda: RewardDelay(LATE)),
    "RewardDelay, worlds": Case(Drift, lambda: RewardDelay({"law": "geometric"})),
    "RewardDelay, agents": Case(uavs, lambda: RewardDelay(LATE, REWARD)),
    "ServerNode": Case(unserved, _served),
}
"""Every transform on an environment of every kind that it works on, named after it."""

DRAWS = [
    CASES[name] for name in CASES if name.split(",")[0] in ("ActionDelay", "ObservationDelay", "RewardDelay")
]
"""Those that draw random numbers."""


def onward(env: EnvBase, td: TensorDictBase, n_steps: int = 6, seed: int = 0) -> list[TensorDictBase]:
    """Go on with random actions and partial resets: what every step and every reset showed."""
    torch.manual_seed(seed)
    shown = []
    for _ in range(n_steps):
        after, td = env.step_and_maybe_reset(env.rand_action(td))
        shown += [after["next"].clone(), td.clone()]
    return shown


def begun(env: EnvBase, n_steps: int = 5, seed: int = 0) -> TensorDictBase:
    """Reset and step for a while: where to go on from."""
    env.set_seed(seed)
    torch.manual_seed(seed)
    td = env.reset()
    return onward(env, td, n_steps, seed)[-1] if n_steps else td


def memory(transform: Transform) -> list[Tensor]:
    """Everything that it remembers."""
    return [value for value in transform.state_dict().values() if value is not None]


def flat(state: dict) -> dict[str, Tensor]:
    """Nested dictionaries of tensors as one."""
    found = {}
    for key, value in state.items():
        inner = flat(value) if isinstance(value, dict) else {"": value}
        found |= {f"{key}.{name}".rstrip("."): tensor for name, tensor in inner.items()}
    return found
