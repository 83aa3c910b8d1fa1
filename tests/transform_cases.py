"""Laws, environments and rollouts on which the delay transforms are tested."""

from collections.abc import Sequence
from typing import Any

import torch
from delay_twin import Counting
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv

from damian.common import counter_rng
from damian.delays.laws import Burst, Geometric, Trace, Uniform
from damian.transforms import (
    StatefulTransform,
)

ACTION, REWARD, OBSERVATION = ("agents", "action"), ("agents", "reward"), ("agents", "observation")
WORLDS, N_AGENTS, STEPS = [3, 5, 8, 13], 2, 40
ROWS = [(world, agent) for world in range(len(WORLDS)) for agent in range(N_AGENTS)]

PAPER = Uniform("3s", "7s", 0.15)
LAWS = {
    "none": lambda _: 0,
    "constant": lambda _: 3,
    "uniform": lambda _: Uniform(1, 4),
    "paper": lambda _: PAPER,
    "geometric": lambda _: Geometric(2, 6),
    "burst": lambda _: Burst(0.2, 0.3, good=Uniform(0, 1), bad=5, bad_loss=0.0),
    "trace": lambda folder: trace(folder, 4, 0, 7, 1, 0, 2, 9, 0, 0, 3),
}
"""Delay laws that lose no message."""


def trace(folder: Any, *delays: Any) -> Trace:
    """A trace of these delays, in a file of the folder."""
    file = folder / f"{len(delays)}.csv"
    file.write_text("\n".join(map(str, ["delay", *delays])))
    return Trace(str(file))


def delayed(*transforms: StatefulTransform, worlds: Sequence[int] = WORLDS, **options: Any) -> TransformedEnv:
    """A ``Counting`` environment with transforms whose draws depend on the names of the worlds."""
    for transform in transforms:
        transform.seed_worlds(torch.tensor(worlds))
    return TransformedEnv(Counting(worlds, N_AGENTS, **options), Compose(*transforms))


def choices(worlds: Sequence[int] = WORLDS, n_steps: int = STEPS) -> list[Tensor]:
    """Actions for each step, [B, N]; those of a world do not depend on the other worlds."""
    names, agents = torch.tensor(worlds).unsqueeze(-1), torch.arange(N_AGENTS)
    return [counter_rng.bits(names, agents, torch.tensor([t])) % Counting.N_ACTIONS for t in range(n_steps)]


def column(outputs: Sequence[TensorDictBase], *key: str) -> list:
    """An entry of every output, as nested lists."""
    return torch.stack([td[key] for td in outputs]).tolist()


def before(outputs: Sequence[TensorDictBase], *key: str) -> list:
    """An entry before each step, as nested lists."""
    return column(outputs[:-1:2], *key)


def after(outputs: Sequence[TensorDictBase], *key: str) -> list:
    """An entry after each step, as nested lists."""
    return column(outputs[1::2], *key)
