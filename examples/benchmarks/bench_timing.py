"""How ``bench.py`` times environments: in turn, with episodes that end at different times.

If all worlds began together, most steps would be without a reset, and a rollout shorter than an
episode would never reset at all. So before the measurement a few worlds at a time are reset until
all have been.
"""

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple, cast

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from tqdm import tqdm


class Measured(NamedTuple):
    """Times of a step over several repetitions [ms]."""

    median: float
    lowest: float
    highest: float
    first: float = 0.0
    """Duration of the very first step [s]; it contains the time to compile."""

    @property
    def spread(self) -> str:
        """Lowest and highest time, as text."""
        return f"{self.lowest:.2f} to {self.highest:.2f}"


def in_turn(
    chunks: Mapping[str, Callable[[], object]], steps: int, repeats: int
) -> dict[str, Measured]:
    """Times of steps, where the chunks take turns, so that a busy machine slows all of them.

    Args:
        chunks: by name, each takes ``steps`` steps; only calls of it are timed.
        steps: number of steps of a chunk.
        repeats: number of measured turns.
    """
    times: dict[str, list[float]] = {name: [] for name in chunks}
    for _ in tqdm(range(repeats), "measuring", leave=False):
        for name, chunk in chunks.items():
            begin = time.perf_counter()
            chunk()
            times[name].append(1e3 * (time.perf_counter() - begin) / steps)
    return {name: Measured(statistics.median(ms), min(ms), max(ms)) for name, ms in times.items()}


def rollout_times(
    envs: Mapping[str, EnvBase], steps: int, repeats: int, groups: int = 25
) -> dict[str, Measured]:
    """Times of the steps of ``rollout`` with random actions.

    Args:
        envs: environments by name.
        steps: steps of a rollout.
        repeats: number of measured rollouts.
        groups: numbers of worlds that begin their episodes at the same time.
    """
    chunks = {}
    first = {}
    for name, env in tqdm(envs.items(), "warming up", leave=False):
        begin = time.perf_counter()
        following = staggered(env, groups)
        first[name] = time.perf_counter() - begin
        chunks[name] = rollouts(env, following, steps).__next__
        chunks[name]()  # what is left to compile
    measured = in_turn(chunks, steps, repeats)
    return {name: times._replace(first=first[name]) for name, times in measured.items()}


def staggered(env: EnvBase, groups: int) -> TensorDictBase:
    """Step an environment with random actions while one group of worlds after the other is
    reset."""
    following = env.reset()
    for group in range(groups):
        _, following = env.step_and_maybe_reset(env.rand_action(following))
        again = torch.zeros(*env.batch_size, 1, dtype=torch.bool)
        again[group::groups] = True
        following = env.reset(following.set("_reset", again))
        following.pop("_reset", None)
    return following


def rollouts(env: EnvBase, following: TensorDictBase, steps: int) -> Iterator[None]:
    """Endless rollouts, each of which goes on where the one before has ended."""
    while True:
        rollout = env.rollout(
            steps, auto_reset=False, tensordict=following, break_when_any_done=False
        )
        following = cast(TensorDictBase, env.maybe_reset(env.step_mdp(rollout[:, -1].clone())))
        yield


def collector_times(
    pairs: Mapping[str, tuple[EnvBase, nn.Module]], steps: int, repeats: int, groups: int = 10
) -> dict[str, Measured]:
    """Times of the steps of TorchRL's ``Collector``.

    Args:
        pairs: environment and policy by name.
        steps: steps of a batch.
        repeats: number of measured batches.
        groups: numbers of worlds that begin their episodes at the same time.
    """
    chunks = {}
    for name, (env, policy) in tqdm(pairs.items(), "warming up", leave=False):
        frames = env.batch_size.numel() * steps
        collector = Collector(env, policy, frames_per_batch=frames, total_frames=-1)
        batches = iter(collector)
        for group in range(groups):
            next(batches)
            collector.reset(torch.arange(env.batch_size[0])[group::groups])
        chunks[name] = batches.__next__
    return in_turn(chunks, steps, repeats)
