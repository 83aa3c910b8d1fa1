"""Every transform on every kind of environment, for the contract that all of them keep."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from environments import KINDS, Kind
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from damian.delays.laws import Uniform
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    Channel,
    CumulativeReward,
    ObservationDelay,
    RewardDelay,
    SampleAndHold,
    StatefulTransform,
    set_seed,
)

LATE = Uniform(1, 3)
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


def channel(kind: Kind, law: Any, **options: Any) -> StatefulTransform:
    """A channel between the agents of a group; it works only where there is one."""
    return Channel(law, kind.observation, loss=0.1, **options)


PAIRS = {f"{name} on {kind}": (KINDS[kind], make) for kind in KINDS for name, make in TRANSFORMS.items()} | {
    f"Channel on {name}": (kind, channel) for name, kind in GROUPS.items()
}
"""Every kind of environment with every transform, and with a channel where that works."""
DRAWING = {name: pair for name, pair in PAIRS.items() if name.partition("Delay")[1] or pair[1] is channel}
drawing = pytest.mark.parametrize(("kind", "make"), DRAWING.values(), ids=DRAWING)


def played(env: EnvBase, kind: Kind, n_steps: int = 8, seed: int | None = 0) -> list[TensorDictBase]:
    """Outputs of every step and every reset, with actions drawn from torch's generator."""
    if seed is not None:
        torch.manual_seed(seed)
        set_seed(env, seed)
    td, outputs = env.reset(), []
    for _ in range(n_steps):
        after, td = env.step_and_maybe_reset(env.rand_action(td))
        outputs += [after["next"].clone(), td.clone()]
    return outputs
