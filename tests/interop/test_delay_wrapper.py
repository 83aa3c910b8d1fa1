"""Delays of environments of Gymnasium and PettingZoo: as the transforms delay those of TorchRL."""

import copy

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Sequence, Text, Tuple
from gymnasium.utils.env_checker import check_env, data_equivalence
from pettingzoo import ParallelEnv
from pettingzoo.test import parallel_api_test
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.libs.pettingzoo import PettingZooWrapper

from damian import (
    ActionDelay,
    ActionHistory,
    ContextSampler,
    CumulativeReward,
    ObservationDelay,
    ObservationTimeline,
    RewardDelay,
    Uniform,
)
from damian.common.errors import InputError
from damian.interop import DelayWrapper
from damian.interop.pettingzoo import DelayParallelWrapper


def by_time(message):
    """Delays that follow from the time alone, so that messages overtake each other without
    chance."""
    return (3 * message.time) % 5


def lost_at_times(message):
    """The same; every fourth message is lost."""
    return torch.where(message.time % 4 == 2, -1.0, by_time(message))


LOSSY = ContextSampler(lost_at_times, 5)


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

    def __init__(self, action_space):
        self.action_space = action_space
        self.observation_space = Dict(
            {
                "place": Box(0, 9, (2,)),
                "word": Text(5),
            }
        )
        self.executed = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.executed = []
        return {"place": np.zeros(2, np.float32), "word": "t0"}, {}

    def step(self, action):
        self.executed.append(action)
        t = len(self.executed)
        return (
            {
                "place": np.full(2, t, np.float32),
                "word": f"t{t}",
            },
            0.0,
            False,
            False,
            {},
        )


@pytest.mark.parametrize(
    ("space", "first"),
    [
        (Box(np.float32(-1), np.float32(3), (2,)), [0, 0]),
        (Discrete(4), 0),
        (MultiDiscrete([3, 4]), [0, 0]),
        (MultiBinary(3), [0, 0, 0]),
        (
            Dict(gas=Box(0.0, 1), gear=Tuple([Discrete(3), Discrete(2)])),
            {
                "gas": 0,
                "gear": (0, 0),
            },
        ),
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
    for options, executed in (
        ({"observation": 2}, 3),
        (
            {
                "action": 1,
                "default": 5,
            },
            5,
        ),
    ):
        env = DelayWrapper(inner, **options)
        env.reset()
        env.step(3)
        assert inner.executed == [executed]


@pytest.mark.filterwarnings("ignore:.*WARN")  # of the wrapped environments themselves
@pytest.mark.parametrize(
    ("name", "wide"),
    [
        (
            "Pendulum-v1",
            {
                "history": 3,
                "timeline": 4,
            },
        ),
        ("CartPole-v1", {}),
    ],
    ids=str,
)
def test_gymnasiums_checker_finds_nothing(name, wide):
    late = DelayWrapper(gymnasium.make(name).unwrapped, Uniform(0, 3), 2, 1, **wide)
    check_env(late, skip_render_check=True)


def test_every_reward_is_received_once_and_the_info_tells_when_it_was_earned():
    plain = gymnasium.make("Pendulum-v1", max_episode_steps=40)
    steps = 40
    env = DelayWrapper(gymnasium.make("Pendulum-v1", max_episode_steps=40), reward=Uniform(0, 30))
    plain.reset(seed=3)
    env.reset(seed=3)
    earned = []
    found = {}
    together = 0
    for step in range(steps):
        action = plain.action_space.sample()
        earned.append(plain.step(action)[1])
        _, reward, _, _, info = env.step(action)
        assert reward == pytest.approx(sum(each for _, each in info["received"]))
        together += len(info["received"]) > 1 and step < steps - 1
        for age, each in info["received"]:
            assert step - age not in found
            found[step - age] = each
    assert found == dict(enumerate(earned))
    assert together


def test_the_parts_of_an_observation_have_laws_of_their_own():
    env = DelayWrapper(Anything(Discrete(3)), {"place": 2, "word": by_time}, timeline=6)
    told, info = env.reset()
    assert info["age"] == {"place": 0, "word": 0}
    arrives = {0: 0} | {t: t + 3 * t % 5 for t in range(1, 10)}
    for now in range(1, 10):
        assert env.observation_space.contains(told)
        told, _, _, _, info = env.step(0)
        word = max(t for t, at in arrives.items() if at <= now)
        assert told["word"] == f"t{word}"
        assert told["place"].tolist() == [max(0, now - 2)] * 2
        assert info["age"] == {"place": min(now, 2), "word": now - word}
        assert told["age"].tolist() == [*info["age"].values()]
        for k in range(6):
            place = told["timeline"][k, :3].tolist()
            word = told["timeline"][k, 3:]
            assert place == ([now - k, now - k, 1] if 2 <= k <= now or k == now else [0, 0, 0])
            known = k <= now and arrives[now - k] <= now
            assert word[-1] == known
            assert word[:-1].any() == known


def test_the_losses_of_parts_are_their_own():
    env = DelayWrapper(Anything(Discrete(3)), loss={"word": 1.0})
    env.reset(seed=0)
    for t in range(1, 4):
        told, *_, info = env.step(0)
        assert (told["word"], told["place"].tolist()) == ("t0", [t, t])
        assert info["age"] == {"place": 0, "word": t}


LINE = Box(-99, 99, (1,), np.float32)


class Overwrites(gymnasium.Env):
    """Counts its steps in arrays that it keeps and returns, and writes over the actions that it
    executes."""

    action_space = LINE
    observation_space = Dict({"gps": LINE, "camera": LINE})

    def __init__(self):
        self.count = np.zeros(1, np.float32)
        self.paid = np.zeros(())
        self.executed = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count[:] = 0
        return {"gps": self.count, "camera": self.count}, {}

    def step(self, action):
        self.count += 1
        self.paid += 1
        self.executed.append(float(action[0]))
        action[:] = -5
        return {"gps": self.count, "camera": self.count}, self.paid, False, False, {}


@pytest.mark.parametrize("parts", [False, True])
def test_nothing_that_is_kept_changes_when_others_write_over_their_arrays(parts):
    inner = Overwrites()
    default = np.full(1, 4, np.float32)
    late = {"observation": {"camera": 2} if parts else 2, "action": 2, "reward": 3}
    env = DelayWrapper(inner, **late, history=3, timeline=4, default=default)
    default[:] = 9
    action = np.zeros(1, np.float32)
    told, _ = env.reset(seed=0)
    seen = []
    rewards = []
    ages = []
    for step in range(1, 7):
        for each in told.values():
            each[...] = -9
        action[...] = step
        told, reward, *_, info = env.step(action)
        seen.append(copy.deepcopy(told))
        rewards.append(float(reward))
        ages.append(info["age"]["camera"] if parts else info["age"])
    held = [0, 0, 1, 2, 3, 4]
    now = [1, 2, 3, 4, 5, 6]
    assert [each["camera"].item() for each in seen] == held
    assert [each["gps"].item() for each in seen] == (now if parts else held)
    assert seen[-1]["timeline"][2:, -2 if parts else 0].tolist() == [4, 3]
    of_actions = [(each["action_history"] * 198 - 99).round().tolist() for each in seen]
    assert of_actions == [[4, 4, 1], [4, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5], [4, 5, 6]]
    assert inner.executed == [4, 4, 1, 2, 3, 4]
    assert rewards == [0, 0, 0, 1, 2, 3]
    assert [np.max(age) for age in ages] == [1, 2, 2, 2, 2, 2]


def test_what_a_user_can_get_wrong_is_said_in_one_line():
    inner = Anything(Discrete(3))
    for options, message in (
        ({"reward": LOSSY}, "reward: .* loses messages"),
        ({"action": {"left": 1}}, "action: left is named, but the names are: none"),
        ({"timeline": -1}, "timeline: -1 steps is not at least 0"),
    ):
        with pytest.raises(InputError, match=message):
            DelayWrapper(inner, **options)
    with pytest.raises(InputError, match="observation: camera is named, but the names are: none"):
        DelayWrapper(gymnasium.make("CartPole-v1"), {"camera": 2})
    with pytest.raises(InputError, match=r"history: Sequence.* has no vectors of a fixed length"):
        DelayWrapper(Anything(Sequence(Discrete(2))), default=(), history=1)
    inner.observation_space = Dict(age=Discrete(3))
    with pytest.raises(InputError, match="observation: age is an entry of it already"):
        DelayWrapper(inner, timeline=2)


# Several agents.


def made_spread():
    spread = pytest.importorskip("mpe2.simple_spread_v3")
    return spread.parallel_env(N=3, max_cycles=12, continuous_actions=True)


def of_sender(message):
    """A delay for each agent: 0, 2 and 5 steps."""
    return torch.tensor([0, 2, 5])[message.sender]


def of_congestion(message):
    return message.n_sending + message.sender + by_time(message)


BY_AGENT = {"agent_1": 2, "agent_2": 5}
WRITTEN = {"held": "observation"} | {key: key for key in ("age", "timeline", "action_history")}


@pytest.mark.parametrize(
    ("law", "given"),
    [
        (3, 3),
        (LOSSY, LOSSY),
        (of_congestion, of_congestion),
        (of_sender, BY_AGENT),
        (of_sender, of_sender),
    ],
    ids=["constant", "lossy", "congestion", "by agent", "by sender"],
)
def test_the_delays_of_agents_are_those_of_the_transforms(law, given):
    observation, action, reward = (("agent", each) for each in ("observation", "action", "reward"))
    of_reward = 3 if law is LOSSY else law
    delays = Compose(
        ActionDelay(law, action),
        ObservationDelay(law, observation, ("agent", "held"), delay_key="delay"),
        RewardDelay(of_reward, reward),
        ActionHistory(3, action),
        ObservationTimeline(7, observation, delay_key="delay"),
    )
    reference = TransformedEnv(PettingZooWrapper(made_spread()), delays)
    reference.set_seed(5)
    inner = made_spread()
    inner.reset(seed=5)
    rewards = {"reward": 3 if given is LOSSY else given}
    env = DelayParallelWrapper(inner, given, given, **rewards, history=3, timeline=7)
    rng = np.random.default_rng(0)
    for _ in range(2):
        now, (told, infos) = reference.reset(), env.reset()
        while env.agents:
            for i, agent in enumerate(env.possible_agents):
                assert env.observation_space(agent).contains(told[agent])
                for key, own in WRITTEN.items():
                    assert np.array_equal(told[agent][own], now["agent", key][i].numpy()), key
                assert infos[agent]["age"] == now["agent", "age"][i].item()
            chosen = rng.uniform(0, 1, (3, 5)).astype(np.float32)
            now["agent", "action"] = torch.as_tensor(chosen)
            now = reference.step(now)["next"]
            told, received, _, truncated, infos = env.step(
                dict(zip(env.agents, chosen, strict=True))
            )
            expected = now["agent", "reward"].flatten().tolist()
            assert [*received.values()] == pytest.approx(expected, rel=1e-5)
        assert all(truncated.values())
        assert now["done"].item()


class Relay(ParallelEnv):
    """Agents observe the step and what they have executed; b dies in step 5, c comes in step 3.

    b may come ``again``, and ``tells`` of its death, or not.
    """

    def __init__(self, again=None, tells=True, names="abc"):
        self.again = again
        self.tells = tells
        self.metadata = {"name": "relay"}
        self.possible_agents = [*names]
        self.observation_spaces = dict.fromkeys(
            self.possible_agents, Box(-99.0, 99.0, (2,), np.float32)
        )
        self.action_spaces = dict.fromkeys(self.possible_agents, Discrete(50))

    def observation_space(self, agent):
        return self.observation_spaces[agent]

    def action_space(self, agent):
        return self.action_spaces[agent]

    def reset(self, seed=None, options=None):
        self.t = 0
        self.agents = ["a", "b"]
        infos = {agent: {"t": 0} for agent in self.agents}
        return {agent: np.zeros(2, np.float32) for agent in self.agents}, infos

    def step(self, actions):
        actions = {
            agent: actions[agent] for agent in self.agents
        }  # TorchRL sends those of the dead, too
        self.t += 1
        present = [
            *self.agents,
            *self.possible_agents[2:] * (self.t == 3),
            *["b"] * (self.t == self.again),
        ]
        ends = {agent: self.t == 9 or (self.t == 5 and agent == "b") for agent in present}
        told = {agent: np.array([self.t, actions.get(agent, -1)], np.float32) for agent in present}
        rewards = {agent: float(10**self.t) for agent in present}
        self.agents = [agent for agent in present if not ends[agent]]
        ends |= {agent: ended and (self.tells or agent != "b") for agent, ended in ends.items()}
        return (
            told,
            rewards,
            ends,
            dict.fromkeys(present, False),
            {agent: {"t": self.t} for agent in present},
        )


@pytest.mark.parametrize("tells", [True, False])
@pytest.mark.parametrize("again", [None, 6, 8])
def test_agents_that_die_or_come_again_are_told_and_paid_as_in_the_transforms(again, tells):
    observation, action, reward = (("agents", each) for each in ("observation", "action", "reward"))
    delays = Compose(
        ActionDelay(1, action),
        ObservationDelay(LOSSY, observation, ("agents", "held"), delay_key="delay"),
        RewardDelay(by_time, reward),
        CumulativeReward(2, reward_key=reward),
        ActionHistory(3, action),
        ObservationTimeline(5, observation, delay_key="delay"),
    )
    inner = Relay(again, names="ab")
    groups = {"agents": inner.possible_agents}
    relay = PettingZooWrapper(inner, use_mask=True, done_on_any=False, group_map=groups)
    reference = TransformedEnv(relay, delays)
    env = DelayParallelWrapper(
        Relay(again, tells, "ab"),
        LOSSY,
        1,
        by_time,
        history=3,
        timeline=5,
    )
    now = reference.reset()
    earned = dict.fromkeys("ab", 0.0)
    env.reset()
    while env.agents:
        chosen = env.unwrapped.t + 1
        now["agents", "action"] = torch.full((2,), chosen)
        now = reference.step(now)["next"]
        told, rewards, *_, infos = env.step(dict.fromkeys(env.agents, chosen))
        assert told.keys() == rewards.keys() == infos.keys()
        for agent in told:
            assert infos[agent]["t"] == chosen
            i = env.possible_agents.index(agent)
            for key in ("held", "age", "timeline"):
                assert np.array_equal(told[agent][WRITTEN[key]], now["agents", key][i].numpy()), key
            history = told[agent]["action_history"].reshape(3, 50).argmax(-1)
            assert np.array_equal(
                history, (49 * now["agents", "action_history"][i]).round().numpy()
            )
            expected = rewards[agent] + 0.9 * (
                0 if env.unwrapped.t == again and agent == "b" else earned[agent]
            )
            assert now["agents", "reward"][i].item() == pytest.approx(expected, rel=1e-5)
        earned |= rewards


def test_an_agent_that_joins_late_begins_with_what_it_sees_then():
    env = DelayParallelWrapper(Relay(), {"c": 2})
    env.reset()
    seen = []
    while env.agents:
        told, *_ = env.step(dict.fromkeys(env.agents, env.unwrapped.t + 1))
        seen.append(told["c"].tolist() if "c" in told else None)
    assert seen == [None, None, *[[3, -1]] * 3, [4, 4], [5, 5], [6, 6], [7, 7]]


def test_only_those_who_are_there_send():
    env = DelayParallelWrapper(Relay(), lambda message: message.n_sending)
    ages = []
    env.reset()
    while env.agents:
        ages.append(env.step(dict.fromkeys(env.agents, 0))[-1]["a"]["age"])
    # Two agents send in steps 1 and 2, three from step 3 to 5, and two from then on.
    assert ages == [1, 2, 2, 2, 3, 3, 3, 2, 2]


def test_agents_draw_different_delays_which_follow_from_the_seed():
    env = DelayParallelWrapper(Relay(), Uniform(0, 4), loss={"b": 1.0})
    found = []
    for seed in (0, 1, 0):
        env.reset(seed=seed)
        ages = []
        while env.agents:
            infos = env.step(dict.fromkeys(env.agents, 0))[-1]
            ages.append({agent: info["age"] for agent, info in infos.items()})
        found.append(ages)
        assert [each["b"] for each in ages[:5]] == [1, 2, 3, 4, 5]
        assert [each["a"] for each in ages[3:]] != [each["c"] for each in ages[3:]]
    assert found[0] == found[2] != found[1]


def test_pettingzoos_checker_finds_nothing(capsys):
    parallel_api_test(
        DelayParallelWrapper(
            made_spread(),
            Uniform(0, 3),
            1,
            2,
            history=2,
            timeline=3,
        ),
        30,
    )
    assert "Passed Parallel API test" in capsys.readouterr().out
