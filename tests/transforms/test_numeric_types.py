"""Types of histories and rewards, and values that share no memory with a transform."""

import pytest
import torch
from contract import CASES
from plain_env import GROUP, Plain
from torchrl.data import Bounded, Categorical, Unbounded
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs
from transform_cases import ACTION, OBSERVATION, REWARD

from damian.transforms import ActionHistory, CumulativeReward, RewardDelay

FLOATS = [torch.float16, torch.bfloat16, torch.float32, torch.float64]
INTEGERS = [torch.uint8, torch.int16, torch.int32, torch.int64]


@pytest.fixture
def double():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def rewards_of(env, n_steps):
    """Rewards of the first steps, which are those of all agents, and their type."""
    td, rewards = env.reset(), []
    for _ in range(n_steps):
        stepped = env.rand_step(td)
        assert env.full_reward_spec[REWARD].is_in(stepped["next", *REWARD])
        rewards.append(stepped["next", *REWARD])
        td = env.step_mdp(stepped)
    assert all((reward == reward[0, 0]).all() for reward in rewards)
    return [reward[0, 0, 0].item() for reward in rewards], rewards[-1].dtype


@pytest.mark.parametrize(
    "action", [Categorical(5, GROUP), Bounded(-2.0, 2.0, (*GROUP, 2))], ids=["discrete", "continuous"]
)
@pytest.mark.parametrize("codes", [None, torch.rand(5, 2).double()], ids=["scaled", "codes"])
@pytest.mark.parametrize("dtype", FLOATS)
def test_a_history_is_appended_in_the_type_of_the_observation(dtype, action, codes):
    codes = codes if isinstance(action, Categorical) else None
    for observation in (Unbounded((*GROUP, 4), dtype=dtype), Bounded(-1, 1, (*GROUP, 4), dtype=dtype)):
        plain = Plain(action, observation)
        env = TransformedEnv(plain, ActionHistory(2, ACTION, append_to=OBSERVATION, codes=codes))
        assert env.observation_spec[OBSERVATION].dtype == dtype
        td = env.rollout(3)
        assert td[OBSERVATION].dtype == td["next", *OBSERVATION].dtype == dtype
        check_env_specs(env)


# Rewards.


@pytest.mark.parametrize("dtype", [*FLOATS, *INTEGERS])
def test_a_delayed_reward_keeps_its_type_also_at_the_end_of_an_episode(dtype):
    env = TransformedEnv(Plain(reward=Unbounded((*GROUP, 1), dtype=dtype), ends=5), RewardDelay(2, REWARD))
    assert env.full_reward_spec[REWARD].dtype == dtype
    assert rewards_of(env, 5) == ([0, 0, 1, 2, 3 + 4 + 5], dtype)
    check_env_specs(env)


@pytest.mark.parametrize("dtype", [*FLOATS, *INTEGERS])
def test_sums_of_integer_rewards_are_float32_and_others_keep_their_type(dtype):
    expected = dtype if dtype.is_floating_point else torch.float32
    env = TransformedEnv(Plain(reward=Unbounded((*GROUP, 1), dtype=dtype)), CumulativeReward(2, 0.5, REWARD))
    assert env.full_reward_spec[REWARD].dtype == expected
    assert rewards_of(env, 4) == ([1.0, 2.5, 4.0, 5.5], expected)
    check_env_specs(env)


@pytest.mark.parametrize("dtype", INTEGERS)
def test_sums_of_one_integer_reward_stay_integers(dtype):
    env = TransformedEnv(Plain(reward=Unbounded((*GROUP, 1), dtype=dtype)), CumulativeReward(1, 0.5, REWARD))
    assert env.full_reward_spec[REWARD].dtype == dtype
    assert rewards_of(env, 3) == ([1, 2, 3], dtype)


@pytest.mark.parametrize("make", [lambda: RewardDelay(2, REWARD), lambda: CumulativeReward(3, 1.0, REWARD)])
def test_sums_of_bounded_rewards_match_their_spec(make):
    reward = Bounded(1, 6, (*GROUP, 1), dtype=torch.int64)
    rewards_of(TransformedEnv(Plain(reward=reward, ends=5), make()), 5)


# Memory.

HISTORIES_AND_REWARDS = {
    name: case
    for name, case in CASES.items()
    if name.split(",")[0] in ("ActionHistory", "RewardDelay", "CumulativeReward")
}
