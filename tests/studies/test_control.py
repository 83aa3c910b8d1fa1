"""The study ``control``: SAC on Pendulum-v1 with the delay transforms."""

import pytest
import torch
from control import Task, draw, evaluate_under, make_env, make_learner, train
from torch import nn
from tqdm import tqdm

from damian import keys, set_seed
from damian.learners.sac import Sac


def learn(delay: int, history: int, steps: int, arm: str = "history") -> nn.Module:
    """The policy that is trained with one seed."""
    torch.manual_seed(0)
    env = make_env(Task(shortest=delay, longest=delay, history=history))
    set_seed(env, 0)
    learner = make_learner(env, arm, steps, delay, 128)
    train(env, learner, steps, tqdm(disable=True))
    return learner.actor


# What the learners of the arms read.

DELAY = 3
LATE = Task(shortest=DELAY, longest=DELAY, history=DELAY)


def collected(arm: str, steps: int) -> Sac:
    """The learner of an arm after random actions."""
    torch.manual_seed(0)
    env = make_env(LATE)
    set_seed(env, 0)
    learner = make_learner(env, arm, 1000, DELAY, 8)
    train(env, learner, steps, tqdm(disable=True))
    return learner


@pytest.mark.parametrize(("arm", "waits"), [("history", 0), ("bpql", DELAY)])
def test_bpql_alone_waits_until_the_observation_after_a_step_has_arrived(arm, waits):
    learner = collected(arm, 20)
    learner.buffer.storage.steps["next", *keys.REWARD][:20] = torch.arange(20.0).view(20, 1, 1)
    drawn = draw(learner)["next", *keys.REWARD].unique()
    assert drawn.tolist() == [*range(20 - waits)]
    read = {"history": keys.OBSERVATION, "bpql": keys.GLOBAL_OBSERVATION}[arm]
    assert learner.loss.qvalue_network.in_keys == [read, keys.ACTION]


@pytest.mark.slow
def test_delay_lowers_the_return_and_the_action_history_restores_it():
    undelayed = learn(delay=0, history=0, steps=9_000)
    returns = {delay: evaluate_under(Task(shortest=delay, longest=delay), undelayed, 20) for delay in (0, 6)}
    assert returns[0] > -300
    assert returns[6] < returns[0] - 300
    naive = evaluate_under(Task(shortest=6, longest=6), learn(delay=6, history=0, steps=12_000), 20)
    for arm, steps in (("history", 12_000), ("bpql", 8_000)):
        aware = evaluate_under(Task(shortest=6, longest=6, history=6), learn(6, 6, steps, arm), 20)
        assert aware > naive + 300, arm
