"""Delays in worker processes, each with a seed of its own."""

from collections.abc import Callable
from functools import partial

from torchrl.envs import EnvBase, GymEnv, ParallelEnv, TransformedEnv

from damian import ObservationDelay, Uniform


def late_cartpole(seed: int) -> TransformedEnv:
    """Runs in each worker."""
    delay = ObservationDelay(Uniform(0, 4), delay_key="delay", seed=seed)
    return TransformedEnv(GymEnv("CartPole-v1"), delay)


def draw(workers: Callable[..., EnvBase]) -> list[list[int]]:
    """The first ten delays of each of two workers."""
    env = workers(2, [partial(late_cartpole, seed) for seed in (0, 1)])
    delays = env.rollout(10, break_when_any_done=False)["next", "delay"].squeeze(-1)
    env.close()
    return delays.tolist()


if __name__ == "__main__":
    print(f"the workers' delays: {draw(ParallelEnv)}; and again: {draw(ParallelEnv)}")
