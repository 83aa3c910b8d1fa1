"""Copies of environments, compiled ones too: each steps its own worlds and has memory of its own."""

import pickle
from multiprocessing.reduction import ForkingPickler

import pytest
from delayed_envs import DELAYS, choices, delayed
from helpers import all_same, everything, play
from torchrl.envs import EnvBase

from damian.keys import ACTION


def sent(env: EnvBase) -> EnvBase:
    """What a worker process receives, with tensors in shared memory."""
    return pickle.loads(ForkingPickler.dumps(env))


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
