"""Environment steps per second of a training with each collector (docs/scaling.md).

    python -m damian.recipes.bench_collectors [ROUNDS] [COLLECTOR ...]

All collectors run at the same time and are measured in turns, a few batches each, so that whatever else the
machine does concerns all of them; the table has medians.
"""

import statistics
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import NamedTuple

import torch

from damian.common.markdown import markdown_table
from damian.common.threads import using_threads
from damian.learners.schedule import SystemClock

from .shared.collecting import collecting, ticks
from .shared.launch import composed_config
from .shared.learning_env import learning_env
from .train import make_learner, replay_buffer

TASKS = {
    "spotting (cheap)": ["scenario=spotting"],
    "tracking with a belief (expensive)": ["scenario=delaybench/tracking", "delay=paper", "aware=belief"],
}
WORKERS = 2
BATCHES = 2
"""Batches of a collector in each round."""


class Rate(NamedTuple):
    """Environment steps per second, over all worlds."""

    collected: float
    trained: float


def rates(words: list[str], stack: ExitStack) -> Iterator[Rate]:
    """Train; yields the speed of collecting, and of collecting and learning, in each update."""
    config = composed_config(*words)
    env, clock = learning_env(config), SystemClock(config.clock, config.update_steps)
    learner = make_learner(config, env, replay_buffer(config, env))
    collector = stack.enter_context(collecting(config, env, learner.actor))
    batches = ticks(collector, clock, env.server)
    while True:
        begin = time.perf_counter()
        batch = next(batches)
        collected = time.perf_counter() - begin
        with using_threads(config.learning_threads):
            learner.learn(batch)
        yield Rate(batch.numel() / collected, batch.numel() / (time.perf_counter() - begin))


def table(kinds: list[str], rounds: int) -> str:
    """Measure all tasks and collectors."""
    rows = []
    for task, words in TASKS.items():
        with ExitStack() as stack:
            runs = {kind: rates([*words, *chosen(kind)], stack) for kind in kinds}
            start = {kind: seconds_of(run) for kind, run in runs.items()}
            measured: dict[str, list[Rate]] = {kind: [] for kind in kinds}
            for _ in range(rounds):
                for kind, run in runs.items():
                    measured[kind] += [next(run) for _ in range(BATCHES)]
        for kind in kinds:
            medians = [statistics.median(rate) for rate in zip(*measured[kind], strict=True)]
            rows.append([task, kind, *(f"{median:.0f}" for median in medians), f"{start[kind]:.0f}"])
    return markdown_table(["task", "collector", "collected/s", "trained/s", "start [s]"], rows, left=2)


def chosen(kind: str) -> list[str]:
    """Overrides that choose a collector."""
    return [] if kind == "sync" else [f"collector={kind}", f"workers={WORKERS}"]


def seconds_of(run: Iterator[Rate]) -> float:
    """Seconds until a run has made its first update."""
    begin = time.perf_counter()
    next(run)
    return time.perf_counter() - begin


if __name__ == "__main__":
    torch.set_num_threads(1)
    number, *names = sys.argv[1:] or ["5"]
    print(table(names or ["sync", "process", "ray"], int(number)))
