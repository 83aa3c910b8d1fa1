"""Agents of VMAS that choose what to say; others hear it some steps later, or never."""

from torchrl.envs import TransformedEnv
from torchrl.envs.libs.vmas import VmasEnv

from damian import Channel, Uniform, set_seed

radio = Channel(
    Uniform(1, 5),  # one draw for each receiver and message
    loss=0.2,  # a fifth of them never arrives
    action_key=("agents", "words"),  # the policy chooses what to send,
    message_size=4,  # four numbers in [-1, 1]
)
env = TransformedEnv(VmasEnv("navigation", num_envs=32, n_agents=3), radio)
set_seed(env, 0)
agents = env.rollout(50)["agents"]
heard = agents["received"]  # [32 worlds, 50 steps, 3 receivers, 3 senders, 4]
age = agents["received_age"]  # [32, 50, 3, 3], and agents["received_mask"]: has any arrived
print(f"mean age of what agents hear of each other: {age[..., 0, 1:].mean():.1f} steps")
