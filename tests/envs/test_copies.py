"""Copies of environments, compiled ones too: each steps its own worlds and has memory of its own."""

import copy
import pickle
from functools import partial
from multiprocessing.reduction import ForkingPickler

import pytest
from delayed_envs import DELAYS, choices, delayed
from helpers import all_same, check_equal, everything, play
from torchrl.envs import EnvBase

from damian.common import compiling
from damian.envs.uav_env import UavEnv
from damian.keys import ACTION


def sent(env: EnvBase) -> EnvBase:
    """What a worker process receives, with tensors in shared memory."""
    return pickle.loads(ForkingPickler.dumps(env))


def pickled(env: EnvBase) -> EnvBase:
    return pickle.loads(pickle.dumps(env))


every_copy = pytest.mark.parametrize("copied", [copy.deepcopy, pickled, sent])


@pytest.fixture
def untraced(monkeypatch: pytest.MonkeyPatch):
    """Takes the methods of environments as compiled, because tracing a graph takes seconds."""
    monkeypatch.setattr(compiling, "compiled", lambda method, **_: method)


def uav_env() -> UavEnv:
    return UavEnv(everything("polynomial"), num_worlds=4)


@every_copy
@pytest.mark.parametrize(
    "make", [uav_env, partial(delayed, everything(**DELAYS["paper"]))], ids=["UavEnv", "DelayedEnv"]
)
def test_a_copy_of_a_compiled_environment_steps_its_own_worlds(make, copied, untraced):
    env = make().compile()
    play(env, choices(env, 3))
    other, state = copied(env), getattr(env, "uav_env", env).state
    outputs = play(other, choices(env, 8))
    check_equal(getattr(env, "uav_env", env).state, state)
    assert all_same(outputs, play(env, choices(env, 8)))


@pytest.mark.parametrize(
    "delays", [pytest.param(name, marks=[] if name == "paper" else pytest.mark.slow) for name in DELAYS]
)
def test_an_environment_sent_to_a_worker_process_shares_no_memory(delays):
    env, alone = (delayed(everything(**DELAYS[delays])) for _ in range(2))
    actions, outputs = choices(env, 12), []
    for each in (env, alone):
        td = each.reset()
        for step, action in enumerate(actions):
            if step == 6 and each is env:  # messages are in transit
                play(sent(env), actions)
            after, td = each.step_and_maybe_reset(td.set(ACTION, action))
            outputs.append(after["next"])
    assert all_same(outputs[:12], outputs[12:])
