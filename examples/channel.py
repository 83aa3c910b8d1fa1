"""How old is what agents know of each other? Three robots of VMAS tell their positions over a slow
radio.

    python examples/channel.py
"""

from torchrl.envs import TransformedEnv
from torchrl.envs.libs.vmas import VmasEnv

from damian import Channel, Uniform


def main(n_worlds: int = 64, n_steps: int = 100) -> dict[str, float]:
    """Print, and return, the mean age of what an agent holds of the others [steps], by channel."""
    channels = {
        "direct": Channel(Uniform(1, 5), loss=0.2, seed=0),
        "within 0.8 m": Channel(
            Uniform(1, 5), loss=0.2, comm_range=0.8, position_key="observation", seed=0
        ),
    }
    results = {}
    for name, channel in channels.items():
        env = TransformedEnv(VmasEnv("navigation", num_envs=n_worlds, n_agents=3, seed=0), channel)
        agents = env.rollout(n_steps)["agents"]
        ages = agents["received_age"].mean((0, 1))
        results[name] = ages[0, 1:].mean().item()
        print(f"{name:18s} what is known of others is {results[name]:4.1f} steps old")
    return results


if __name__ == "__main__":
    main()
