"""Delays of stored steps equal those that the same transforms make in the environment."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from delay_twin import Counting, Purse, Receiver, drawn, last_actions, looking_back
from helpers import same, square
from tensordict import LazyStackedTensorDict, TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import (
    Compose,
    EnvBase,
    GymEnv,
    InitTracker,
    RewardSum,
    SerialEnv,
    StepCounter,
    Transform,
    TransformedEnv,
)
from transform_cases import ACTION, LAWS, N_AGENTS, OBSERVATION, REWARD, ROWS, STEPS, WORLDS, delayed

from damian.common.errors import InputError
from damian.delays.laws import Uniform
from damian.envs.uav_env import UavEnv
from damian.transforms import (
    ActionDelay,
    ActionHistory,
    CumulativeReward,
    ObservationDelay,
    RewardDelay,
    SampleAndHold,
    ServerNode,
    delay_trajectories,
)
from damian.transforms.skip_until_ready import SkipUntilReady

LATE = Uniform(0, 3)


def vmas() -> EnvBase:
    """A multi-agent environment of VMAS."""
    pytest.importorskip("vmas")
    from torchrl.envs.libs.vmas import VmasEnv  # noqa: PLC0415

    return VmasEnv("balance", num_envs=2, seed=0, max_steps=5, n_agents=2)


ROOT = ("observation", "action", "reward")
AGENTS = (OBSERVATION, ACTION, REWARD)
KINDS: dict[str, tuple[Callable[[], EnvBase], Any]] = {
    "Pendulum": (lambda: GymEnv("Pendulum-v1"), ROOT),
    "CartPole": (lambda: GymEnv("CartPole-v1"), ROOT),
    "CartPole, two": (lambda: SerialEnv(2, lambda: GymEnv("CartPole-v1")), ROOT),
    "counting": (lambda: Counting(WORLDS), AGENTS),
    "counting, continuous": (lambda: Counting(WORLDS, continuous=True), AGENTS),
    "VMAS": (vmas, AGENTS),
}
CHAINS: dict[str, Callable[[Any, Any, Any], Transform]] = {
    "observation": lambda o, a, r: ObservationDelay(
        LATE, [o], loss=0.1, fresh_key="new", delay_key="d", seed=1
    ),
    "reward": lambda o, a, r: RewardDelay(LATE, r, seed=1),
    "sum": lambda o, a, r: CumulativeReward(3, 0.9, r),
    "clock": lambda o, a, r: SampleAndHold(3, [o]),
    "history": lambda o, a, r: ActionHistory(2, a, append_to=o),
    "all": lambda o, a, r: Compose(
        ObservationDelay(LATE, [o], order="arrival", seed=1),
        Compose(RewardDelay(LATE, r, seed=2), CumulativeReward(2, 0.9, r)),
        SampleAndHold(2, [o], age_key="age"),
        ActionHistory(2, a, append_to=o, age_key="age"),
        RewardSum([r], ["sum"] if isinstance(r, str) else [("agents", "sum")]),
        InitTracker(),
    ),
}


def collect(env: EnvBase, n_steps: int = 30) -> TensorDictBase:
    """Steps under random actions, the same at each call, with resets in between; [*, T]."""
    env.set_seed(0)
    torch.manual_seed(0)
    return env.rollout(n_steps, break_when_any_done=False)


def counted(n_steps: int = STEPS, **options: Any) -> TensorDictBase:
    """Steps of ``Counting``, [B, T]."""
    return collect(Counting(WORLDS, **options), n_steps)


@pytest.mark.sample(3)
@pytest.mark.parametrize("chain", CHAINS)
@pytest.mark.parametrize("kind", KINDS)
def test_stored_steps_are_delayed_as_in_the_environment(kind, chain):
    make, keys = KINDS[kind]
    env = TransformedEnv(make(), CHAINS[chain](*keys))
    online, stored = collect(env), collect(make())
    assert online[keys[1]].equal(stored[keys[1]])
    found = delay_trajectories(stored, env.transform, action_spec=make().action_spec)
    assert same(found, online)
    assert found.batch_size == online.batch_size
    assert found.names == online.names


def test_all_episodes_of_these_environments_but_pendulums_end_and_begin_again():
    for kind, (make, _) in KINDS.items():
        assert collect(make())["next", "done"].any() == (kind != "Pendulum")


# Beside reference implementations in plain Python.


@pytest.fixture(params=LAWS)
def law(request, tmp_path):
    return LAWS[request.param](tmp_path)


def delays_of(late: Any) -> list:
    """Delays that a transform draws in ``Counting``, which numbers its worlds, as nested lists [T][M]."""
    delayed(late).reset()
    return drawn(late.sampler, late.memory["streams"], STEPS).tolist()


def listed(data: TensorDictBase, *key: str) -> list:
    """An entry [B, T, ...] as nested lists."""
    return data[key].tolist()


@pytest.mark.parametrize("order", ["generation", "arrival"])
def test_every_agent_holds_the_message_that_the_reference_receiver_holds(law, order):
    data = counted()
    late = ObservationDelay(law, [OBSERVATION], order=order, loss=0.2, sent_key="message_sent")
    table, found = delays_of(late), delay_trajectories(data, late)
    before, after = listed(data, *OBSERVATION), listed(data, "next", *OBSERVATION)
    done, sent = listed(data, "next", "done"), listed(data, "next", "agents", "message_sent")
    now_held, now_age = listed(found, *OBSERVATION), listed(found, "agents", "age")
    held, age = listed(found, "next", *OBSERVATION), listed(found, "next", "agents", "age")
    for row, (w, n) in enumerate(ROWS):
        receiver = Receiver(order)
        for t in range(STEPS):
            if t == 0 or done[w][t - 1][0]:
                receiver.begin(t, before[w][t][n])
            assert [now_held[w][t][n], now_age[w][t][n]] == [
                receiver.holds.content,
                [t - receiver.holds.sent],
            ]
            delay = table[t][row]
            arrives = delay < late.sampler.lost and sent[w][t][n]
            receiver.step(t + 1, after[w][t][n], delay if arrives else None)
            assert [held[w][t][n], age[w][t][n]] == [receiver.holds.content, [t + 1 - receiver.holds.sent]]


def test_every_agent_is_paid_by_the_reference_purse_which_keeps_what_is_in_transit_at_the_end(law):
    data, late = counted(), RewardDelay(law, REWARD)
    table, received = delays_of(late), listed(delay_trajectories(data, late), "next", *REWARD)
    earned, done = listed(data, "next", *REWARD), listed(data, "next", "done")
    for row, (w, n) in enumerate(ROWS):
        purse = Purse()
        for t in range(STEPS):
            paid = purse.step(t, earned[w][t][n][0], table[t][row], done[w][t][0])
            assert received[w][t][n][0] == paid
        unpaid = sum(reward for _, reward in purse.in_transit)
        total = [sum(step[n][0] for step in rewards[w]) for rewards in (earned, received)]
        assert total[0] == total[1] + unpaid


def test_sums_clocks_and_histories_begin_anew_with_each_episode():
    data, clock = counted(), SampleAndHold(3, [("agents", "message_sent")])
    chain = Compose(CumulativeReward(3, 0.5, REWARD), clock, ActionHistory(3, ACTION, default=2))
    found = delay_trajectories(data, chain, action_spec=Counting([0, 1]).full_action_spec)
    keys = REWARD, ACTION, ("agents", "message_sent"), ("done",)
    earned, chosen, sent, done = (listed(data, *(key if key == ACTION else ("next", *key))) for key in keys)
    first = listed(data, "agents", "message_sent")
    summed, held = listed(found, "next", *REWARD), listed(found, "next", "agents", "message_sent")
    history = found["next", "agents", "action_history"]
    for w, n in ROWS:
        rewards: list[float] = []
        actions: list[int] = []
        sampled = first[w][0][n]
        for t in range(STEPS):
            rewards.append(earned[w][t][n][0])
            actions.append(chosen[w][t][n])
            sampled = sent[w][t][n] if len(rewards) % 3 == 0 else sampled
            assert [summed[w][t][n][0], held[w][t][n]] == [looking_back(rewards, 3, 0.5), sampled]
            assert history[w, t, n].equal(torch.tensor(last_actions(actions, 3, 2)) / 6)
            if done[w][t][0] and t + 1 < STEPS:
                rewards, actions, sampled = [], [], first[w][t + 1][n]


# Where episodes begin.


def test_rows_that_were_cut_and_joined_begin_anew():
    one, other = counted(12, ends=0.0), counted(9, ends=0.1)
    late = Compose(ObservationDelay(3, [OBSERVATION]), RewardDelay(2, REWARD))
    found = delay_trajectories(torch.cat([one, other], 1), late)
    assert same(found, torch.cat([delay_trajectories(part, late) for part in (one, other)], 1))


def test_worlds_one_after_the_other_in_one_row_begin_anew():
    data, late = counted(10), ObservationDelay(3, [OBSERVATION])
    found = delay_trajectories(data.reshape(-1), late)
    assert same(found, delay_trajectories(data, late).reshape(-1))


def test_an_episode_begins_after_the_end_of_another_even_where_nothing_else_tells():
    steps = {"observation": torch.zeros(6, 1), "action": torch.zeros(6, 1)}
    done = torch.tensor([0, 0, 1, 0, 0, 0], dtype=torch.bool).unsqueeze(-1)
    after = {"observation": torch.zeros(6, 1), "reward": torch.ones(6, 1), "done": done}
    data = TensorDict({**steps, "next": TensorDict(after, [6])}, [6])
    found = delay_trajectories(data, Compose(ObservationDelay(2), RewardDelay(2)))
    assert found["age"].flatten().tolist() == [0, 1, 2, 0, 1, 2]
    assert found["next", "reward"].flatten().tolist() == [0, 0, 3, 0, 0, 1]


@pytest.mark.parametrize("key", ["is_init", ("collector", "traj_ids"), "begins"])
def test_a_flag_or_the_number_of_the_trajectory_tells_where_an_episode_begins(key):
    data = counted(8, ends=0.0)
    again = torch.arange(8).expand(len(WORLDS), 8) == torch.tensor([2, 3, 4, 9]).unsqueeze(-1)
    data = data.set(key, again.long().cumsum(-1) if key[0] == "collector" else again.unsqueeze(-1))
    late = ObservationDelay(2, [OBSERVATION])
    ages = delay_trajectories(data, late, start_key="begins" if key == "begins" else None)["agents", "age"]
    expected = [
        [0, 1, 0, 1, 2, 2, 2, 2],
        [0, 1, 2, 0, 1, 2, 2, 2],
        [0, 1, 2, 2, 0, 1, 2, 2],
        [0, 1, *[2] * 6],
    ]
    assert ages[:, :, 0, 0].tolist() == expected


def test_with_a_start_key_nothing_else_counts():
    data = counted(STEPS)
    data = data.set("begins", torch.zeros(data.shape, dtype=torch.bool))
    ages = delay_trajectories(data, ObservationDelay(2, [OBSERVATION]), start_key="begins")["agents", "age"]
    assert ages[..., 0, 0].tolist() == [[0, 1, *[2] * (STEPS - 2)]] * len(WORLDS)


def test_a_missing_value_goes_on_as_a_missing_value():
    data = counted(6, ends=0.0)
    for td in (data, data["next"]):
        td[OBSERVATION] = td[OBSERVATION].index_fill(-1, torch.tensor([0]), torch.nan)
    ages = delay_trajectories(data, ObservationDelay(2, [OBSERVATION]))["agents", "age"]
    assert ages[0, :, 0, 0].tolist() == [0, 1, 2, 2, 2, 2]


# Replay buffers.


def test_steps_go_out_of_a_replay_buffer_and_into_another_one_delayed():
    data, late = counted(10), ObservationDelay(LATE, [OBSERVATION], seed=3)
    undelayed = ReplayBuffer(storage=LazyTensorStorage(10 * len(WORLDS), ndim=2))
    undelayed.extend(data)
    delayed = ReplayBuffer(storage=LazyTensorStorage(1000))
    delayed.extend(delay_trajectories(undelayed[:], late).reshape(-1))
    found = delayed.sample(16)
    assert found["next", "agents", "age"].shape == (16, N_AGENTS, 1)
    expected = delay_trajectories(data, late).reshape(-1)
    assert same(delayed[:].exclude("index"), expected)


def test_a_transform_of_a_replay_buffer_says_what_to_call_instead():
    buffer = ReplayBuffer(storage=LazyTensorStorage(100), transform=ObservationDelay(2, [OBSERVATION]))
    buffer.extend(counted(5).reshape(-1))
    with pytest.raises(RuntimeError, match="delay_trajectories"):
        buffer.sample(4)


@pytest.mark.parametrize("lazy", [False, True])
def test_data_and_transform_stay_as_they_are(lazy):
    data, late = counted(10), ObservationDelay(LATE, [OBSERVATION], seed=3)
    data = LazyStackedTensorDict(*data.unbind(1), stack_dim=1) if lazy else data
    copy = data.clone()
    found = delay_trajectories(data, late)
    found.apply_(lambda value: value.zero_())
    assert same(data, copy)
    assert not late.has_memory
    assert same(delay_trajectories(data, late), delay_trajectories(data, late))


# What is refused.


def server_node() -> Transform:
    return ServerNode(UavEnv(square(), num_worlds=1, extras=["message"], messages_only=True).server)


REFUSED = {
    "ActionDelay changes which actions": lambda: ActionDelay(2, ACTION),
    "SampleAndHold changes which actions": lambda: SampleAndHold(2, [OBSERVATION], [ACTION]),
    "ServerNode changes how long": server_node,
    "SkipUntilReady changes how long": SkipUntilReady,
    "ends episodes where": lambda: StepCounter(max_steps=3),
}


@pytest.mark.parametrize("text", REFUSED)
def test_a_transform_that_would_have_changed_what_happened_is_refused(text):
    with pytest.raises(InputError, match=text) as error:
        delay_trajectories(counted(8), Compose(RewardSum([REWARD], ["sum"]), REFUSED[text]()))
    assert "\n" not in str(error.value)


def test_a_history_needs_the_range_of_the_actions():
    data, history = counted(5), ActionHistory(2, ACTION)
    with pytest.raises(InputError, match="action_spec: it is needed"):
        delay_trajectories(data, history)
    with pytest.raises(InputError, match=r"of shape \(1, 2, 2\) does not fit the stored"):
        delay_trajectories(data, history, action_spec=Counting([0], continuous=True).action_spec)
    with pytest.raises(InputError, match="chosen is not among the keys"):
        delay_trajectories(data, ActionHistory(2, "chosen"), action_spec=Counting([0]).action_spec)


def test_what_is_no_transform_is_refused_and_so_is_data_without_steps():
    late = ObservationDelay(1, [OBSERVATION])
    for wrong in ([late], None, ObservationDelay):
        with pytest.raises(InputError, match=r"transform: .* is not a transform, such as Obs.* Compose\("):
            delay_trajectories(counted(5), wrong)  # type: ignore[arg-type]
    for data, shape in ((counted(5)[:, :0], r"\[4, 0\]"), (counted(5)[0][:0], r"\[0\]")):
        with pytest.raises(InputError, match=f"data: shape {shape} has no steps"):
            delay_trajectories(data, late)


def test_steps_without_what_is_needed_are_refused():
    late = ObservationDelay(1, [OBSERVATION])
    with pytest.raises(InputError, match=r'no \("next", "done"\)'):
        delay_trajectories(counted(5).exclude("next"), late)
    with pytest.raises(InputError, match="time last"):
        delay_trajectories(counted(5).transpose(0, 1), late)
    flat = counted(5).set(("next", "done"), torch.zeros(4, 5, dtype=torch.bool))
    with pytest.raises(InputError, match=r"shape \(4, 5\) is not \(4, 5, 1\)"):
        delay_trajectories(flat, late)
    with pytest.raises(InputError, match="is not among the keys"):
        delay_trajectories(TensorDict(counted(5).exclude(("next", *OBSERVATION)), [4, 5]), late)
    with pytest.raises(InputError, match="start_key: begins is not in the data"):
        delay_trajectories(counted(5), late, start_key="begins")
