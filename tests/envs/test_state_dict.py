"""``env.state_dict()`` of a whole environment: an equal one that loads it goes on in the same way."""

import io

import pytest
import torch
from delayed_envs import DELAYS
from helpers import all_same, everything
from torchrl.collectors import Collector
from torchrl.envs import RewardSum, StepCounter

from damian.envs.delayed_env import DelayedEnv
from damian.envs.pipeline import make_env
from damian.envs.uav_env import EXTRAS

QUICK = ("everything", "polynomial")


def built(delays: str, motion: str, n_worlds: int = 4) -> DelayedEnv:
    env = make_env(everything(motion, **DELAYS[delays]), n_worlds, extras=EXTRAS)
    env.append_transform(RewardSum())
    env.append_transform(StepCounter())
    return env


def through_a_file(state):
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


@pytest.mark.parametrize(
    ("delays", "motion"),
    [
        pytest.param(delays, motion, marks=[] if (delays, motion) == QUICK else [pytest.mark.slow])
        for delays in DELAYS
        for motion in ("instant", "polynomial")
    ],
)
def test_an_equal_environment_that_loads_a_state_goes_on_in_the_same_way(delays, motion):
    env, twin = built(delays, motion), built(delays, motion)
    twin.set_seed(5)
    step = env.rollout(9, break_when_any_done=False)[:, -1]["next"].exclude("reward")
    state = through_a_file(env.state_dict())
    twin.rollout(2)
    twin.load_state_dict(state)
    actions = [env.rand_action(step.clone())[("agents", "action")] for _ in range(25)]
    one, other = (played(each, step.clone(), actions) for each in (env, twin))
    assert all(all_same(a, b) for a, b in zip(one, other, strict=True))


def played(env, step, actions) -> list:
    steps = []
    for action in actions:
        step[("agents", "action")] = action
        taken, step = env.step_and_maybe_reset(step)
        steps.append(taken["next"])
    return steps


def test_a_state_as_torchrls_collector_saves_it_leaves_the_worlds():
    env = built("paper", "instant")
    collector = Collector(env, frames_per_batch=8, total_frames=8)
    before = env.uav_env.worlds
    env.load_state_dict(collector.state_dict()["env_state_dict"])
    assert env.uav_env.worlds is before
    collector.shutdown()
