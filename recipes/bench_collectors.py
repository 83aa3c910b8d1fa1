"""Environment steps per second with each collector (docs/scaling.md).

    python -m damian.recipes.bench_collectors [ROUNDS]

All collectors run at the same time and take turns, a few batches each, and so does learning, so that whatever
else the machine does concerns all of them. The numbers are medians.
"""

import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import torch
from tensordict import TensorDictBase

from damian.common.markdown import markdown_table
from damian.common.threads import using_threads
from damian.learners.schedule import SystemClock

from .shared.collecting import collecting, ticks
from .shared.launch import composed_config
from .shared.learning_env import learning_env
from .train import make_learner, replay_buffer

TRACKING = ["scenario=delaybench/tracking", "delay=paper", "aware=belief"]
TASKS = {
    "spotting, 64 worlds": ["scenario=spotting"],
    "tracking with a belief, 128 worlds": TRACKING,
    "tracking with a belief, 1024 worlds": [*TRACKING, "worlds=1024"],
}
COLLECTORS: dict[str, list[str]] = {
    "sync": [],
    "process": ["collector=process", "workers=2"],
    "ray": ["collector=ray", "workers=2"],
}
"""Overrides that choose each collector."""
BATCHES = 3
"""Batches of a collector in each round."""

Learn = Callable[[TensorDictBase], object]


def begun(words: list[str], stack: ExitStack) -> tuple[Iterator[TensorDictBase], Learn]:
    """Start a training; returns its batches, the first of which has been collected, and how it learns."""
    config = composed_config(*words)
    env, clock = learning_env(config), SystemClock(config.clock, config.update_steps)
    learner = make_learner(config, env, replay_buffer(config, env))
    batches = ticks(stack.enter_context(collecting(config, env, learner.actor)), clock, env.server)
    next(batches)

    def learn(batch: TensorDictBase) -> None:
        with using_threads(config.learning_threads):
            learner.learn(batch)

    return batches, learn


def rows(task: str, words: list[str], rounds: int) -> Iterator[list[str]]:
    """Measure the collectors in a task; yields a row of the table for each."""
    with ExitStack() as stack:
        start, runs = {}, {}
        for name, choice in COLLECTORS.items():
            begin = time.perf_counter()
            runs[name] = begun([*words, *choice], stack)
            start[name] = time.perf_counter() - begin
        seconds: dict[str, list[float]] = {name: [] for name in (*runs, "learning")}
        batch = next(runs["sync"][0])
        for _ in range(rounds):
            for name, (batches, _) in runs.items():
                for _ in range(BATCHES):
                    begin = time.perf_counter()
                    batch = next(batches)
                    seconds[name].append(time.perf_counter() - begin)
            begin = time.perf_counter()
            runs["sync"][1](batch)
            seconds["learning"].append(time.perf_counter() - begin)
    median = {name: statistics.median(found) for name, found in seconds.items()}
    for name in runs:
        rates = [batch.numel() / (median[name] + more) for more in (0, median["learning"])]
        yield [task, name, *(f"{rate:.0f}" for rate in rates), f"{start[name]:.0f}"]


if __name__ == "__main__":
    torch.set_num_threads(1)
    measured = [row for task in TASKS.items() for row in rows(*task, int((sys.argv[1:] or ["5"])[0]))]
    heads = ["task", "collector", "collected/s", "collected and learnt/s", "start [s]"]
    print(markdown_table(heads, measured, left=2))
