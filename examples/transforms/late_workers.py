"""Delays in worker processes: one seed for all, and a stream of delays for each worker."""

from collections.abc import Callable

from torchrl.envs import EnvBase, GymEnv, ParallelEnv, TransformedEnv

from damian import ObservationDelay, Uniform


def late_cartpole() -> TransformedEnv:
    """Runs in each worker."""
    return TransformedEnv(GymEnv("CartPole-v1"), ObservationDelay(Uniform(0, 4), delay_key="delay"))


def draw(workers: Callable[..., EnvBase]) -> list[list[int]]:
    """The first ten delays of each of two workers."""
    env = workers(2, late_cartpole)
    env.set_seed(0)
    delays = env.rollout(10, break_when_any_done=False)["next", "delay"].squeeze(-1)
    env.close()
    return delays.tolist()


if __name__ == "__main__":
    print(f"the workers' delays: {draw(ParallelEnv)}; and again: {draw(ParallelEnv)}")
