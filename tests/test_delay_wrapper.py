"""The example for any environment of Gymnasium: it delays as the transforms delay those of TorchRL."""

import copy
import re
import textwrap

import delay_wrapper
import gymnasium
import numpy as np
import pytest
import torch
from delay_wrapper import DelayWrapper
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, Sequence, Text, Tuple
from gymnasium.utils.env_checker import check_env, data_equivalence
from torchrl.envs import Compose, GymEnv, TransformedEnv

from damian import (
    ActionDelay,
    ActionHistory,
    ContextSampler,
    ObservationDelay,
    ObservationTimeline,
    RewardDelay,
    Uniform,
)
from damian.common.errors import InputError


def by_time(message):
    """Delays that follow from the time alone, so that messages overtake each other without
    chance."""
    return (3 * message.time) % 5


def lost_at_times(message):
    """The same; every fourth message is lost."""
    return torch.where(message.time % 4 == 2, -1.0, by_time(message))


LOSSY = ContextSampler(lost_at_times, 5)
LINE = Box(-99, 99, (1,), np.float32)


class Counter(gymnasium.Env):
    """Counts its steps in a word, and in arrays that it keeps and returns; writes over the actions
    that it executes."""

    observation_space = Dict({"gps": LINE, "place": LINE, "word": Text(5)})

    def __init__(self, action_space=LINE):
        self.action_space = action_space
        self.count = np.zeros(1, np.float32)
        self.paid = np.zeros(())
        self.executed = []

    def _seen(self):
        return {"place": self.count, "word": f"t{self.count.item():.0f}", "gps": self.count}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count[:] = 0
        return self._seen(), {}

    def step(self, action):
        self.executed.append(copy.deepcopy(action))
        if self.action_space is LINE:
            action[:] = -5
        self.count += 1
        self.paid += 1
        return self._seen(), self.paid, False, False, {}


def test_its_text_shows_how_to_use_it():
    (code,) = re.findall(r"\n\n(    .*?)\n\n\S", delay_wrapper.__doc__, re.DOTALL)
    found = {}
    exec(textwrap.dedent(code), found)
    assert found["observation"]["timeline"].shape == (8, 4 + 1)
    assert found["observation"]["action_history"].shape == (6 * 2,)
    assert found["info"]["received"] == []


@pytest.mark.parametrize("law", [3, by_time, LOSSY], ids=["constant", "by time", "lossy"])
def test_delays_are_those_of_the_transforms_in_every_episode(law):
    late = 2 if law is LOSSY else law
    delays = Compose(
        ActionDelay(law),
        ObservationDelay(law, "observation", "held", delay_key="delay"),
        RewardDelay(late),
        ActionHistory(3),
        ObservationTimeline(7, delay_key="delay"),
    )
    reference = TransformedEnv(GymEnv("Pendulum-v1", max_episode_steps=12), delays)
    plain = gymnasium.make("Pendulum-v1", max_episode_steps=12)
    reference.set_seed(5)
    plain.reset(seed=5)
    env = DelayWrapper(plain, law, law, late, history=3, timeline=7)
    for _ in range(2):
        now = reference.reset()
        told, info = env.reset()
        ended = False
        while not ended:
            assert env.observation_space.contains(told)
            assert np.array_equal(told["observation"], now["held"].numpy())
            for key in ("age", "timeline", "action_history"):
                assert np.array_equal(told[key], now[key].numpy()), key
            assert info["age"] == now["age"].item()
            action = env.action_space.sample()
            now["action"] = torch.as_tensor(action)
            now = reference.step(now)["next"]
            told, reward, _, ended, info = env.step(action)
            assert reward == pytest.approx(now["reward"].item(), rel=1e-5)
        assert now["done"].item()


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


@pytest.mark.parametrize(
    ("space", "first"),
    [
        (Discrete(4), 0),
        (MultiBinary(3), [0, 0, 0]),
        (Dict(gas=Box(0.0, 1), gear=Tuple([Discrete(3)])), {"gas": 0, "gear": (0,)}),
    ],
    ids=str,
)
def test_any_space_is_delayed_and_the_default_is_the_action_zero(space, first):
    inner = Counter(space)
    env = DelayWrapper(inner, observation=2, action=1)
    env.reset(seed=0)
    actions = [space.sample() for _ in range(4)]
    assert [env.step(action)[0]["word"] for action in actions] == ["t0", "t0", "t1", "t2"]
    assert np.array_equal(inner.executed[0], first)
    assert space.contains(inner.executed[0])
    assert data_equivalence(inner.executed[1:], actions[:3])


@pytest.mark.filterwarnings("ignore:.*WARN")  # of the wrapped environments themselves
@pytest.mark.parametrize(
    ("name", "wide"), [("Pendulum-v1", {"history": 3, "timeline": 4}), ("CartPole-v1", {})], ids=str
)
def test_gymnasiums_checker_finds_nothing(name, wide):
    late = DelayWrapper(gymnasium.make(name).unwrapped, Uniform(0, 3), 2, 1, **wide)
    check_env(late, skip_render_check=True)


def test_every_reward_is_received_once_and_the_info_tells_when_it_was_earned():
    plain, wrapped = (gymnasium.make("Pendulum-v1", max_episode_steps=40) for _ in range(2))
    env = DelayWrapper(wrapped, reward=Uniform(0, 30))
    plain.reset(seed=3)
    env.reset(seed=3)
    earned = []
    found = []
    for step in range(40):
        action = plain.action_space.sample()
        earned.append((step, plain.step(action)[1]))
        _, reward, _, _, info = env.step(action)
        assert reward == pytest.approx(sum(each for _, each in info["received"]))
        found += [(step - age, each) for age, each in info["received"]]
    assert sorted(found) == earned
    assert found != earned


def test_the_parts_of_an_observation_have_laws_and_losses_of_their_own():
    laws = {"place": 2, "word": by_time}
    env = DelayWrapper(Counter(), laws, loss={"gps": 1.0}, timeline=6)
    told, info = env.reset()
    assert info["age"] == {"place": 0, "word": 0, "gps": 0}
    arrives = {0: 0} | {t: t + 3 * t % 5 for t in range(1, 10)}
    for now in range(1, 10):
        assert env.observation_space.contains(told)
        told, *_, info = env.step(np.zeros(1, np.float32))
        word = max(t for t, at in arrives.items() if at <= now)
        assert (told["word"], told["place"], told["gps"]) == (f"t{word}", max(0, now - 2), 0)
        assert info["age"] == {"place": min(now, 2), "word": now - word, "gps": now}
        assert told["age"].tolist() == [*info["age"].values()]
        for k in range(6):
            gps, place, word = np.split(told["timeline"][k], [2, 4])
            assert gps.tolist() == [0, k == now]
            assert place.tolist() == ([now - k, 1] if 2 <= k <= now or k == now else [0, 0])
            known = k <= now and arrives[now - k] <= now
            assert (word[-1], word[:-1].any()) == (known, known)


@pytest.mark.parametrize("late", [2, {"place": 2}], ids=["whole", "parts"])
def test_nothing_that_is_kept_changes_when_others_write_over_their_arrays(late):
    inner = Counter()
    default = np.full(1, 4, np.float32)
    env = DelayWrapper(inner, late, 2, 3, history=3, timeline=4, default=default)
    default[:] = 9
    action = np.zeros(1, np.float32)
    told, _ = env.reset(seed=0)
    seen = []
    rewards = []
    for step in range(1, 7):
        for name in ("gps", "place", "timeline", "action_history"):
            told[name][...] = -9
        action[...] = step
        told, reward, *_ = env.step(action)
        seen.append(copy.deepcopy(told))
        rewards.append(reward)
    held = [0, 0, 1, 2, 3, 4]
    assert [each["place"].item() for each in seen] == held
    assert [each["gps"].item() for each in seen] == (held if late == 2 else [1, 2, 3, 4, 5, 6])
    assert seen[-1]["timeline"][2:, 1 if late == 2 else 2].tolist() == [4, 3]
    of_actions = [(each["action_history"] * 198 - 99).round().tolist() for each in seen]
    assert of_actions == [[4, 4, 1], [4, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5], [4, 5, 6]]
    assert inner.executed == [4, 4, 1, 2, 3, 4]
    assert rewards == [0, 0, 0, 1, 2, 3]


def test_what_a_user_can_get_wrong_is_said_in_one_line():
    for space, options, message in (
        (LINE, {"reward": LOSSY}, "reward: .* loses messages"),
        (LINE, {"observation": {"left": 1}}, "observation: left is no part of the observation"),
        (LINE, {"timeline": -1}, "timeline: -1 steps is not at least 0"),
        (Discrete(4, start=2), {"action": 1}, "default: is missing"),
        (Sequence(Discrete(2)), {"default": (), "history": 1}, "history: .* no vectors of a fixed"),
    ):
        with pytest.raises(InputError, match=message):
            DelayWrapper(Counter(space), **options)
    inner = Counter()
    inner.observation_space = Dict(age=Discrete(3))
    with pytest.raises(InputError, match="observation: age is an entry of it already"):
        DelayWrapper(inner, timeline=2)
    DelayWrapper(Counter(Discrete(4, start=2)), 2)  # no default is needed: no action is late
