"""Delays of a Gymnasium environment: as the transforms delay TorchRL's, whatever the spaces are."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Text, Tuple
from gymnasium.utils.env_checker import check_env, data_equivalence
from torchrl.envs import Compose, GymEnv, TransformedEnv

from damian import ActionDelay, ObservationDelay, Uniform
from damian.common.errors import InputError
from damian.delays.samplers import MessageContext
from damian.interop import DelayWrapper


def by_time(message: MessageContext) -> torch.Tensor:
    """Delays that follow from the time alone, so that messages overtake each other without chance."""
    return (3 * message.time) % 5


@pytest.mark.parametrize("name", ["Pendulum-v1", "CartPole-v1"])
@pytest.mark.parametrize(("observation", "action"), [(0, 0), (3, 0), (0, 2), (by_time, 1), (2, by_time)])
def test_the_wrapper_delays_as_the_transforms_do(name, observation, action):
    delays = Compose(ActionDelay(action), ObservationDelay(observation))
    reference = TransformedEnv(GymEnv(name, categorical_action_encoding=True), delays)
    reference.set_seed(5)
    now = reference.reset()
    inner = gymnasium.make(name)
    inner.reset(seed=5)  # as GymEnv does when it is seeded, before its first reset
    env = DelayWrapper(inner, observation, action)
    held, info = env.reset()
    rng = np.random.default_rng(0)
    for _ in range(40):
        assert np.array_equal(held, now["observation"].numpy())
        assert info["age"] == now["age"].item()
        low, high = (-2, 2) if name == "Pendulum-v1" else (0, 2)
        chosen = rng.uniform(low, high, 1).astype(np.float32) if low else int(rng.integers(high))
        now["action"] = torch.as_tensor(chosen)
        now = reference.step(now)["next"]
        held, reward, terminated, _, info = env.step(chosen)
        assert reward == pytest.approx(now["reward"].item(), rel=1e-6)
        assert terminated == now["terminated"].item()
        if terminated:
            break


def test_drawn_delays_have_their_frequencies():
    env = DelayWrapper(gymnasium.make("Pendulum-v1", max_episode_steps=3000), Uniform(0, 1), loss=0.5)
    env.reset(seed=0)
    ages = [env.step(env.action_space.sample())[-1]["age"] for _ in range(3000)]
    # The newest message is there with probability 1/4; else the one before, with 1/2, or an older one.
    shares = np.bincount(ages, minlength=3)[:3] / 3000
    assert shares == pytest.approx([1 / 4, 3 / 4 * 1 / 2, 3 / 8 * 1 / 2], abs=0.03)


def test_delays_follow_from_the_seed_and_later_episodes_hold_nothing_of_earlier_ones():
    env = DelayWrapper(gymnasium.make("Pendulum-v1"), Uniform(0, 4))
    found = []
    for seed in (0, None, 0, None, 1):
        _, info = env.reset(seed=seed)
        assert info["age"] == 0
        ages = [env.step(env.action_space.sample())[-1]["age"] for _ in range(20)]
        assert all(age <= t + 1 for t, age in enumerate(ages))
        found.append(ages)
    assert found[0] == found[2] != found[1] == found[3]
    assert found[4] != found[0]


class Anything(gymnasium.Env):
    """An environment whose observations are dicts, and which remembers what it has executed."""

    def __init__(self, action_space: gymnasium.Space) -> None:
        self.action_space = action_space
        self.observation_space = Dict({"place": Box(0, 9, (2,)), "word": Text(5)})
        self.executed: list = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.executed = []
        return {"place": np.zeros(2, np.float32), "word": "t0"}, {}

    def step(self, action):
        self.executed.append(action)
        t = len(self.executed)
        return {"place": np.full(2, t, np.float32), "word": f"t{t}"}, 0.0, False, False, {}


@pytest.mark.parametrize(
    ("space", "first"),
    [
        (Box(np.float32(-1), np.float32(3), (2,)), [0, 0]),
        (Discrete(4), 0),
        (MultiDiscrete([3, 4]), [0, 0]),
        (MultiBinary(3), [0, 0, 0]),
        (Dict(gas=Box(0.0, 1), gear=Tuple([Discrete(3), Discrete(2)])), {"gas": 0, "gear": (0, 0)}),
    ],
    ids=str,
)
def test_any_space_is_delayed_and_the_default_is_the_action_zero(space, first):
    inner = Anything(space)
    env = DelayWrapper(inner, observation=2, action=1)
    env.reset(seed=0)
    actions = [space.sample() for _ in range(4)]
    words = [env.step(action)[0]["word"] for action in actions]
    assert words == ["t0", "t0", "t1", "t2"]
    assert np.array_equal(inner.executed[0], first)
    assert space.contains(inner.executed[0])
    assert data_equivalence(inner.executed[1:], actions[:3])


def test_a_space_without_zero_asks_for_a_default_only_where_an_action_is_late():
    inner = Anything(Discrete(4, start=2))
    for late in (1, Uniform(0, 2)):
        with pytest.raises(InputError, match="default: is missing"):
            DelayWrapper(inner, action=late)
    for options, executed in (({"observation": 2}, 3), ({"action": 1, "default": 5}, 5)):
        env = DelayWrapper(inner, **options)
        env.reset()
        env.step(3)
        assert inner.executed == [executed]


@pytest.mark.filterwarnings("ignore:.*WARN")  # of the wrapped environments themselves
@pytest.mark.parametrize("name", ["Pendulum-v1", "CartPole-v1"])
def test_gymnasiums_checker_finds_nothing(name):
    check_env(DelayWrapper(gymnasium.make(name).unwrapped, Uniform(0, 3), 2), skip_render_check=True)
