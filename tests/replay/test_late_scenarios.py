"""UAVs whose rewards are late too, or summed, or whose server has a slow clock: hindsight equals no
delay."""

from dataclasses import replace

import pytest
import torch
from helpers import everything, random_actions, square
from torchrl.data import ReplayBuffer
from torchrl.envs import StepCounter
from twin import GLOBAL, LOCAL

from damian import ClockConfig, keys, make_env
from damian.delays.config import DelayConfig, LinkConfig
from damian.envs.recompute import CORRECTED, server_recompute
from damian.keys import next_key
from damian.replay.backupdate import BackupdateStorage, corrections_of
from damian.server.config import EpisodeConfig, ObservationConfig, RewardConfig
from damian.world.config import ActionConfig, MotionConfig, RequestConfig, SourceConfig

STEPS = 40
WORLDS = 4
LONGEST = 5
LATE = f"0..{LONGEST}"
SUMMED = {"reward_window": 3, "reward_discount": 0.7}
ENDS = ["success", "done", "terminated", "truncated"]


def training_env(scenario, n_worlds=WORLDS):
    env = make_env(scenario, n_worlds, extras={"message", "reward_terms"})
    env.append_transform(StepCounter())
    return env


def fly(env, n_steps=STEPS):
    """Steps [T, B] with random actions, the same at each call."""
    generator = torch.Generator().manual_seed(5)
    steps = []
    td = env.reset()
    for _ in range(n_steps):
        action = random_actions(env.base_env, generator)
        after, td = env.step_and_maybe_reset(td.set(keys.ACTION, action))
        steps.append(after.clone())
    return torch.stack(steps)


def buffer_of(env, corrected):
    """A buffer in which late messages and rewards correct what is named."""
    late = env.delays.obs.late
    recompute = server_recompute(env.server, corrected, reward_terms=True) if late else None
    names = corrected if late else ["reward"]
    corrections = corrections_of(env.transform, [CORRECTED[name] for name in names])
    size = 3 * STEPS * env.batch_size[0]
    return ReplayBuffer(
        storage=BackupdateStorage(size, recompute, LONGEST, corrections=corrections)
    )


def in_order(buffer):
    """The stored steps in order of time, [T, B]."""
    return buffer.storage[buffer.storage.latest()]


def backupdated(scenario, corrected, n_worlds=WORLDS, n_steps=STEPS):
    """Such steps as collected, and as corrected by all that has arrived after the last one,
    [T, B]."""
    env = training_env(scenario, n_worlds)
    buffer = buffer_of(env, corrected)
    late = fly(env, n_steps)
    for steps in late.split(8):
        buffer.extend(steps.transpose(0, 1))
    return late, in_order(buffer)


REQUESTS = {
    "source": SourceConfig(level_db=142.0),
    "requests": RequestConfig(rate=40.0, most=3),
    "observation": ObservationConfig(["served"], ["others", "requests"], own=True),
    "reward": RewardConfig(spotted=0.0, served=1.0),
}
UNSURE = SourceConfig(count=2, level_db=140.0, miss=0.4, false_alarm=0.3)
CASES = {
    "late messages": {"delay": DelayConfig(obs=LATE)},
    "late messages, the same features for all": {
        "delay": DelayConfig(obs=LATE, history=2),
        "observation": ObservationConfig(LOCAL, GLOBAL, ctde=True),
    },
    "late messages, summed rewards": {"delay": DelayConfig(obs=LATE, **SUMMED)},
    "late messages, slow server": {
        "delay": DelayConfig(obs=LATE),
        "clock": ClockConfig(server="3s"),
    },
    "late messages and rewards": {"delay": DelayConfig(obs=LATE, rew=LATE)},
    "late and summed rewards": {"delay": DelayConfig(rew=LATE, **SUMMED)},
    "order of arrival": {
        "delay": DelayConfig(obs=LATE, rew=3, order="arrival", **SUMMED),
        "clock": ClockConfig(server="4s"),
    },
    "slow agents, history": {
        "delay": DelayConfig(obs=LATE, rew=LATE, history=2, **SUMMED),
        "clock": ClockConfig(server="2s", agents="4s"),
    },
    "late messages of two stops, timeline": {
        "delay": DelayConfig(obs=LATE),
        "observation": ObservationConfig(
            ["spotted"], ["detections", "events"], timeline=7, stops=2, own=True
        ),
    },
    "late messages, absolute commands": {
        "delay": DelayConfig(obs=LATE, act="0..2", act_loss=0.1),
        "actions": ActionConfig(command="absolute"),
        "observation": ObservationConfig(LOCAL, GLOBAL, timeline=7, own=True),
    },
    "late truth": {
        "delay": DelayConfig(obs=LATE),
        "source": UNSURE,
        "reward": RewardConfig(source_distance=0.5, detection="truth"),
    },
    "links": {
        "delay": DelayConfig(obs=LATE, rew=LATE),
        "clock": ClockConfig(server="2s"),
        "links": LinkConfig("matrix", delay=1),
    },
}
FLYING = {
    "late messages of two stops, timeline",
    "late messages",
    "late messages, slow server",
    "late and summed rewards",
    "order of arrival",
    "slow agents, history",
}
"""Cases with real flights, in which a UAV is silent for longer than any message takes; in the others
UAVs move at once."""


@pytest.mark.sample(3)
@pytest.mark.parametrize("name", CASES)
def test_hindsight_equals_the_same_pipeline_without_late_messages_and_rewards(name):
    case = CASES[name]
    motion = "polynomial" if name in FLYING else "instant"
    scenario = everything(motion, episode=EpisodeConfig(max_steps=9), **case)
    on_time = replace(
        scenario,
        delay=replace(
            scenario.delay,
            obs=0,
            rew=0,
            order="generation",
        ),
    )
    late_messages = scenario.make_delays().obs.late
    actor = scenario.links.kind == "server" and late_messages
    corrected = ["reward", "critic", *["actor"] * actor]
    rollouts = (*backupdated(scenario, corrected), fly(training_env(on_time)))
    late, found, true = (steps[: STEPS - LONGEST] for steps in rollouts)
    after = [keys.REWARD, keys.GLOBAL_OBSERVATION, *ENDS]
    if late_messages:
        after += [(*keys.REWARD_TERMS, term) for term in scenario.reward.terms]
    for key in [next_key(key) for key in after] + [keys.GLOBAL_OBSERVATION]:
        assert found[key].equal(true[key]), key
    assert not late[next_key(keys.REWARD)].equal(true[next_key(keys.REWARD)])
    assert found[keys.BACKUPDATED].any()
    if actor:
        n_features = true[keys.OBSERVATION].shape[-1] - 2 * scenario.delay.history
        for key in (keys.OBSERVATION, next_key(keys.OBSERVATION)):
            assert found[key][..., :n_features].equal(true[key][..., :n_features]), key
            assert found[key][..., n_features:].equal(late[key][..., n_features:]), key
            assert not late[key][..., :n_features].equal(true[key][..., :n_features])


@pytest.mark.parametrize("loss", [0.0, 0.5])
def test_in_hindsight_requests_are_known_at_once_and_paid_once_where_the_message_arrived(loss):
    flying = MotionConfig(kind="polynomial", max_speed=40.0, max_acceleration=20.0)
    scenario = square(
        agents=1, motion=flying, episode=EpisodeConfig(30), **REQUESTS
    )  # nobody else tells
    delayed = replace(scenario, delay=DelayConfig(obs=LATE, loss=loss))
    rollouts = (*backupdated(delayed, ["reward", "critic"], 16), fly(training_env(scenario, 16)))
    late, found, true = (steps[: STEPS - LONGEST] for steps in rollouts)
    reward = next_key(keys.REWARD)
    critic = next_key(keys.GLOBAL_OBSERVATION)
    arrived = late[next_key(keys.DELAY)] >= 0
    lost = true[next_key(keys.MESSAGE_SENT)].unsqueeze(-1) & ~arrived
    assert found[reward].equal(true[reward] * ~lost)
    assert found[critic].equal(true[critic]) == (loss == 0)
    assert 5 < late[reward].sum() <= true[reward].sum()
    assert not late[reward].equal(true[reward])


@pytest.mark.parametrize("corrected", [["reward"], ["critic"]], ids="+".join)
def test_only_what_is_named_is_corrected(corrected):
    late, found = backupdated(square(delay=DelayConfig(obs=3)), corrected)
    for name in ("reward", "critic"):
        key = next_key(CORRECTED[name])
        assert found[key].equal(late[key]) == (name not in corrected)


@pytest.mark.parametrize(
    "success",
    [
        {"episode": EpisodeConfig(12, success_share=0.3)},
        {
            "episode": EpisodeConfig(12, all_sources=True),
            "source": UNSURE,
            "reward": RewardConfig(detection="truth"),
        },
    ],
)
def test_a_success_that_the_server_hears_of_late_ends_the_episode_where_it_happened(success):
    scenario = square(**success)
    _, corrected = backupdated(
        replace(scenario, delay=DelayConfig(obs=3)), ["reward", "critic"], 16, 60
    )
    first_episode = corrected["step_count"].squeeze(-1).cumsum(0) == torch.arange(60).cumsum(
        0
    ).view(60, 1)
    valid = first_episode & corrected["valid"].squeeze(-1)
    ends, true_ends = (
        td["next", "success"].squeeze(-1) for td in (corrected, fly(training_env(scenario, 16), 60))
    )
    for b in range(16):
        steps = valid[:, b].nonzero().flatten()
        if true_ends[: len(steps), b].any():
            assert ends[steps, b].tolist() == true_ends[: len(steps), b].tolist()
    assert (~corrected["valid"]).any()
    assert corrected["next", "done"][corrected["reset_after"]].all()
