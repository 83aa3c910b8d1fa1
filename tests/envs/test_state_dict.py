"""Copies and states of whole environments: another environment goes on as they did, and shares no
memory."""

import pickle
from multiprocessing.reduction import ForkingPickler

import pytest
from delayed_envs import DELAYS, choices, delayed
from helpers import all_same, both_motions, everything, play, saved_and_loaded
from torchrl.collectors import Collector
from torchrl.envs import RewardSum, StepCounter

from damian import make_env
from damian.envs.uav_env import EXTRAS
from damian.keys import ACTION


def some(fast):
    """Every delay; all but the ``fast`` one are slow tests."""
    names = [pytest.param(n, marks=[] if n == fast else pytest.mark.slow) for n in DELAYS]
    return pytest.mark.parametrize("delays", names)


def built(delays, motion, n_worlds=4):
    env = make_env(everything(motion, **DELAYS[delays]), n_worlds, extras=EXTRAS)
    env.append_transform(RewardSum())
    env.append_transform(StepCounter())
    return env


@some("paper")
def test_an_environment_sent_to_a_worker_process_shares_no_memory(delays):
    env, alone = (delayed(everything(**DELAYS[delays])) for _ in range(2))
    actions = choices(env, 12)
    outputs = []
    for each in (env, alone):
        td = each.reset()
        for step, action in enumerate(actions):
            if step == 6 and each is env:  # messages are in transit
                play(
                    pickle.loads(ForkingPickler.dumps(env)), actions
                )  # what a worker process receives
            after, td = each.step_and_maybe_reset(td.set(ACTION, action))
            outputs.append(after["next"])
    assert all_same(outputs[:12], outputs[12:])


@some("everything")
@both_motions
def test_an_equal_environment_that_loads_a_state_goes_on_in_the_same_way(delays, motion):
    env = built(delays, motion)
    twin = built(delays, motion)
    twin.set_seed(5)
    step = env.rollout(9, break_when_any_done=False)[:, -1]["next"].exclude("reward")
    state = saved_and_loaded(env.state_dict())
    twin.rollout(2)
    twin.load_state_dict(state)
    steps = []
    for each in (env, twin):
        td = step.clone()
        for action in choices(env, 12):
            taken, td = each.step_and_maybe_reset(td.set(ACTION, action))
            steps.append(taken["next"])
    assert all_same(steps[:12], steps[12:])


def test_a_state_as_torchrls_collector_saves_it_leaves_the_worlds():
    env = built("paper", "instant")
    collector = Collector(env, frames_per_batch=8, total_frames=8)
    before = env.uav_env.worlds
    env.load_state_dict(collector.state_dict()["env_state_dict"])
    assert env.uav_env.worlds is before
    collector.shutdown()
