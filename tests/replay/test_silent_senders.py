"""Back-updating where a sender is silent for longer than any message takes, as a UAV in flight is."""

import torch
from helpers import square
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer

from damian import keys
from damian.delays.config import DelayConfig
from damian.keys import next_key
from damian.learners.mappo import MappoConfig
from damian.learners.networks import ModelConfig
from damian.recipes.config import TrainConfig
from damian.recipes.train import learning_env, replay_buffer
from damian.replay.backupdate import BackupdateStorage
from damian.runs.config import LoggerConfig
from damian.server.termination import EpisodeConfig
from damian.world.motion import MotionConfig

LONGEST = 3


def silent_steps(n: int, delay: dict[int, int], held: list[int]) -> TensorDictBase:
    """Steps [1, n] of one sender, whose message of step t is t, without an end.

    Args:
        n: number of steps.
        delay: delay of each message by its step; the others are not sent.
        held: the message that the receiver holds after each step.
    """
    t, false = torch.arange(n).view(1, n, 1), torch.zeros(1, n, 1, dtype=torch.bool)
    received = torch.tensor(held).view(1, n, 1)
    after = {
        "message": t.float(),
        "received": received.float(),
        "delay": torch.tensor([delay.get(step, -1) for step in range(n)]).view(1, n, 1),
        "age": (t - received).float(),
        "reward": torch.zeros(1, n, 1),
        **dict.fromkeys(("done", "terminated", "truncated"), false),
    }
    return TensorDict({"step_count": t, "next": TensorDict(after, [1, n])}, [1, n])


def storage() -> tuple[BackupdateStorage, ReplayBuffer]:
    """A storage in which the reward becomes the newest message known."""
    names = {"message_key": "message", "received_key": "received", "delay_key": "delay", "age_key": "age"}
    kept = BackupdateStorage(
        60, lambda _, messages: {("next", "reward"): messages}, LONGEST, hindsight_key="hindsight", **names
    )
    return kept, ReplayBuffer(storage=kept)


def entry(kept: BackupdateStorage, key: NestedKey = ("next", "reward")) -> list[float]:
    """The numbers of an entry at the stored steps, in order of time."""
    return kept[kept.latest()][key].flatten().tolist()


def test_an_older_message_that_arrives_last_never_replaces_a_newer_one():
    # The message of step 2 arrives in step 3, that of step 1 in step 4, and then none is sent.
    steps = silent_steps(20, {0: 0, 1: 3, 2: 1}, [0, 0, 0, 2, *[1] * 16])
    kept, buffer = storage()
    for part in steps.split(2, 1):
        buffer.extend(part)
    assert entry(kept) == [0.0, 1.0, *[2.0] * 18]
    # Every stored reward is 0, so that each message but the first one changes it.
    assert entry(kept, "backupdated") == [False, *[True] * 19]
    assert entry(kept, "hindsight_age") == [0, 0, *range(18)]


def truth(env, steps: TensorDictBase) -> Tensor:
    """The rewards of steps [T, B], had all messages that were sent arrived at once, [T, B, N]."""
    sent = env.server.messages(steps[next_key(keys.MESSAGE)])
    return env.server(sent, steps["next", "step_count"].squeeze(-1)).reward


def test_the_programs_learn_the_same_rewards_from_flights_in_any_order_of_arrival():
    delay = DelayConfig(obs={"law": "uniform", "low": 0, "high": 4}, order="arrival")
    motion = MotionConfig(kind="polynomial", max_speed=10.0, max_acceleration=2.0)
    scenario = square(delay=delay, motion=motion, episode=EpisodeConfig(max_steps=60))
    config = TrainConfig(
        **vars(scenario),
        learner=MappoConfig(steps=5),
        model=ModelConfig(hidden=[8]),
        logger=LoggerConfig(tensorboard=False),
        worlds=24,
        backupdate=True,
    )
    env = learning_env(config)
    buffer, flight = replay_buffer(config, env), env.rollout(100, break_when_any_done=False)
    assert buffer is not None
    for part in flight.split(5, 1):
        buffer.extend(part)
        kept = buffer.storage
        steps = kept.steps[kept.latest(5 + 4)[:-4]]
        assert steps[next_key(keys.REWARD)].squeeze(-1).equal(truth(env, steps))
