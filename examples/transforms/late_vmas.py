"""Agents of VMAS, each of which has delays of its own."""

from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.libs.vmas import VmasEnv

from damian import ActionDelay, Burst, ObservationDelay, set_seed

delays = Compose(
    ActionDelay(1, ("agents", "action")),  # a nested key: one draw for each agent
    ObservationDelay(Burst(enter=0.1, leave=0.3, bad=5), [("agents", "observation")]),
)
env = TransformedEnv(VmasEnv("balance", num_envs=32, n_agents=3), delays)
set_seed(env, 0)
age = env.rollout(50, break_when_any_done=False)[
    "agents", "age"
]  # [32 worlds, 50 steps, 3 agents, 1]
print(f"mean age of each agent's observation: {age.mean((0, 1, 3)).tolist()} steps")
