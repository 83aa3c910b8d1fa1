"""Time a step of JaxMARL's simple_spread with random actions, in a Python that has JaxMARL but not
damian.

    python examples/benchmarks/bench_jaxmarl.py 1024
    (worlds; prints milliseconds per step of all worlds)

``bench.py`` runs it where ``make bench-jaxmarl`` has installed JaxMARL. Steps are one compiled scan
on one thread, in which worlds whose episodes end begin anew; the first scan, which compiles, is not
timed.
"""

import os
import statistics
import sys
import time

os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
os.environ["JAX_PLATFORMS"] = "cpu"

import jax
import jaxmarl

STEPS = 50
REPEATS = 7


def milliseconds(worlds: int) -> float:
    """Median time of a step of all worlds [ms]."""
    env = jaxmarl.make("MPE_simple_spread_v3")
    _, state = jax.vmap(env.reset)(jax.random.split(jax.random.PRNGKey(0), worlds))

    def step(carried, key):
        key_act, key_step = jax.random.split(key)
        drawn = jax.random.randint(key_act, (len(env.agents), worlds), 0, 5)
        actions = dict(zip(env.agents, drawn, strict=True))
        seen, after, reward, done, _ = jax.vmap(env.step)(
            jax.random.split(key_step, worlds), carried, actions
        )
        return after, (seen, reward, done)

    rollout = jax.jit(lambda begin, key: jax.lax.scan(step, begin, jax.random.split(key, STEPS)))
    times = []
    for repeat in range(REPEATS + 1):
        begin = time.perf_counter()
        state, _ = jax.block_until_ready(rollout(state, jax.random.PRNGKey(repeat)))
        times.append(1e3 * (time.perf_counter() - begin) / STEPS)
    return statistics.median(times[1:])


if __name__ == "__main__":
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    print(milliseconds(int(sys.argv[1])))
