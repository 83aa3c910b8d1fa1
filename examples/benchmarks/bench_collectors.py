"""Environment steps per second with each collector (docs/scaling.md).

    python examples/benchmarks/bench_collectors.py [ROUNDS]          (make bench-collectors)

All collectors run at the same time and take turns, a few batches each, and so does learning, so that whatever
else the machine does concerns all of them. The numbers are medians.
"""

import statistics
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack

import torch

from damian.common.markdown import markdown_table
from damian.common.threads import using_threads
from damian.learners.schedule import SystemClock
from damian.recipes.cli import settings as composed_config
from damian.recipes.shared.collectors import collecting, learning_env, ticks
from damian.recipes.train import make_learner, replay_buffer

TRACKING = ["scenario=delaybench/tracking", "delay=paper", "aware=belief"]
TASKS = {
    "spotting, 64 worlds": ["scenario=spotting"],
    "tracking with a belief, 128 worlds": TRACKING,
    "tracking with a belief, 1024 worlds": [*TRACKING, "worlds=1024"],
}
COLLECTORS = {"sync": [], "process": ["collector=process", "workers=2"]}
COLLECTORS["ray"] = ["collector=ray", "workers=2"]
BATCHES = 3  # of a collector in each round


def rows(task: str, words: list[str], rounds: int) -> Iterator[list[str]]:
    """Measure the collectors in a task; yields a row of the table for each."""
    with ExitStack() as stack:
        start, runs, learn = {}, {}, None
        for name, choice in COLLECTORS.items():
            begin = time.perf_counter()
            config = composed_config(*words, *choice)
            env, clock = learning_env(config), SystemClock(config.clock, config.update_steps)
            learner = make_learner(config, env, replay_buffer(config, env))
            learn = learn or learner.learn
            collector = stack.enter_context(collecting(config, env, learner.actor))
            runs[name] = ticks(collector, clock, env.server)
            next(runs[name])
            start[name] = time.perf_counter() - begin
        seconds: dict[str, list[float]] = {name: [] for name in (*runs, "learning")}
        for _ in range(rounds):
            for name, batches in runs.items():
                for _ in range(BATCHES):
                    begin = time.perf_counter()
                    batch = next(batches)
                    seconds[name].append(time.perf_counter() - begin)
            begin = time.perf_counter()
            with using_threads(config.learning_threads):
                learn(batch)
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
