"""Types of histories and rewards, and ages that a clock holds."""

import pytest
import torch
from plain_env import GROUP, Plain
from torchrl.data import Bounded, Categorical, Unbounded
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs
from transform_cases import ACTION, OBSERVATION, REWARD

from damian.transforms import ActionHistory, CumulativeReward, MessageHistory, RewardDelay


def rewards_of(env, n_steps):
    """Rewards of the first steps, which are those of all agents, and their type."""
    check_env_specs(env)
    rewards = env.rollout(n_steps)["next", *REWARD]
    return rewards[0, :, 0, 0].tolist(), rewards.dtype


@pytest.mark.parametrize("codes", [None, torch.rand(5, 2).double()], ids=["scaled", "codes"])
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
def test_a_history_is_appended_in_the_type_of_the_observation(dtype, codes):
    for observation in (Unbounded((*GROUP, 4), dtype=dtype), Bounded(-1, 1, (*GROUP, 4), dtype=dtype)):
        plain = Plain(Categorical(5, GROUP), observation)
        env = TransformedEnv(plain, ActionHistory(2, ACTION, append_to=OBSERVATION, codes=codes))
        assert env.observation_spec[OBSERVATION].dtype == dtype
        td = env.rollout(3)
        assert td[OBSERVATION].dtype == td["next", *OBSERVATION].dtype == dtype
        check_env_specs(env)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int64])
def test_a_delayed_reward_keeps_its_type_and_a_sum_is_a_float(dtype):
    reward = Bounded(0, 6, (*GROUP, 1), dtype=dtype)
    delayed = TransformedEnv(Plain(reward=reward, ends=5), RewardDelay(2, REWARD))
    assert rewards_of(delayed, 5) == ([0, 0, 1, 2, 3 + 4 + 5], dtype)
    summed = TransformedEnv(Plain(reward=reward), CumulativeReward(2, 0.5, REWARD))
    expected = dtype if dtype.is_floating_point else torch.float32
    assert rewards_of(summed, 4) == ([1.0, 2.5, 4.0, 5.5], expected)


def test_a_history_of_messages_has_the_type_of_its_spec():
    env = TransformedEnv(
        Plain(observation=Unbounded((*GROUP, 4), dtype=torch.int64)), MessageHistory(3, OBSERVATION)
    )
    check_env_specs(env)
    assert env.rollout(3)["agents", "history"].dtype == torch.float32
