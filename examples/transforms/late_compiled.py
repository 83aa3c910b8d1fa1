"""A step with all of its delays, compiled into one graph: of any environment in PyTorch, and of the
UAVs."""

from typing import Any

import torch
from torchrl.envs import Compose, PendulumEnv, TransformedEnv

from damian import DelayConfig, ObservationDelay, RewardDelay, ScenarioConfig, Uniform, make_env


def main(num_worlds: int = 1024, **options: Any) -> None:
    """Compile two environments with these options of ``torch.compile``, and step them."""
    delays = Compose(ObservationDelay(Uniform(1, 3), ["th", "thdot"]), RewardDelay(1))
    pendulum = TransformedEnv(PendulumEnv(), delays)
    step = torch.compile(pendulum.step, fullgraph=True, **options)
    after = step(pendulum.rand_action(pendulum.reset()))["next"]
    print(f"age of what is known of the pendulum: {after['age'].item():.0f} step")

    late = DelayConfig(obs={"law": "uniform", "low": 1, "high": 4}, act=1, rew=2)
    uavs = make_env(ScenarioConfig(agents=3, delay=late), num_worlds).compile(**options)
    print(f"steps of UAVs: {uavs.rollout(20, break_when_any_done=False).numel()}")


if __name__ == "__main__":
    main()
