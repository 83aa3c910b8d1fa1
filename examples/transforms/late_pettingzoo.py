"""Agents of PettingZoo whose observations arrive out of order."""

from mpe2 import simple_spread_v3
from torchrl.envs import TransformedEnv
from torchrl.envs.libs.pettingzoo import PettingZooWrapper

from damian import ObservationDelay, Uniform, set_seed

spread = PettingZooWrapper(simple_spread_v3.parallel_env(N=3, max_cycles=25))
late = ObservationDelay(Uniform(0, 4), [("agent", "observation")], order="arrival")
env = TransformedEnv(spread, late)
set_seed(env, 0)
age = env.rollout(25)["agent", "age"]  # [25 steps, 3 agents, 1]
print(f"oldest observation of each agent: {age.amax((0, 2)).tolist()} steps")
