"""``EpisodeTotals`` around environments that are not ours (ours: ``tests/envs/test_step_and_reset.py``)."""

import torch
from torchrl.envs import Compose, GymEnv, RewardSum, SerialEnv, StepCounter, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from damian.transforms.reward import EpisodeTotals

COUNTED = ("episode_reward", "step_count", ("next", "episode_reward"), ("next", "step_count"))


def carts(*transforms: Transform) -> TransformedEnv:
    env = TransformedEnv(SerialEnv(3, lambda: GymEnv("CartPole-v1")), Compose(*transforms))
    env.set_seed(0)
    torch.manual_seed(0)
    return env


def totals() -> EpisodeTotals:
    return EpisodeTotals("reward", "episode_reward", "step_count")


def test_totals_equal_those_of_torchrl():
    ours, torchrls = (
        carts(*transforms).rollout(60, break_when_any_done=False)
        for transforms in ([totals()], [RewardSum(), StepCounter()])
    )
    assert ours["next", "done"].any()
    for key in COUNTED:
        assert torch.equal(ours[key], torchrls[key])
        assert ours[key].dtype == torchrls[key].dtype


def test_the_specs_are_right():
    check_env_specs(carts(totals()))
