"""The study ``control``: SAC on Pendulum-v1 with the delay transforms."""

import pytest
import torch
from control import Task, draw, make_env, make_learner, train
from tqdm import tqdm

from damian import keys, set_seed

DELAY = 3


def trained(task, bpql):
    """The learner of a method after 20 steps with random actions."""
    torch.manual_seed(0)
    env = make_env(task)
    set_seed(env, 0)
    learner = make_learner(env, bpql, 1000, task.longest, 8)
    train(env, learner, 20, tqdm(disable=True))
    return learner


@pytest.mark.parametrize(
    ("bpql", "waits"),
    [
        (False, 0),
        (True, DELAY),
    ],
)
def test_bpql_alone_waits_until_the_observation_after_a_step_has_arrived(bpql, waits):
    learner = trained(Task(shortest=DELAY, longest=DELAY, history=DELAY), bpql)
    learner.buffer.storage.steps["next", *keys.REWARD][:20] = torch.arange(20.0).view(20, 1, 1)
    drawn = draw(learner)["next", *keys.REWARD].unique()
    assert drawn.tolist() == [*range(20 - waits)]
    read = keys.GLOBAL_OBSERVATION if bpql else keys.OBSERVATION
    assert learner.loss.qvalue_network.in_keys == [read, keys.ACTION]


def test_critics_read_what_was_true_and_actors_what_had_arrived():
    learner = trained(Task(shortest=1, longest=DELAY, history=DELAY), True)
    steps = learner.buffer.storage.steps[: 20 - DELAY, 0]["next"]
    assert steps[keys.GLOBAL_OBSERVATION].equal(steps["observation"])
    late = torch.cat([steps["age"], steps["received"]], -1)
    assert steps[keys.OBSERVATION][:, :4].equal(late)
    assert not late[:, 1:].equal(steps["observation"])


def test_a_copy_of_pendulum_flies_what_is_late_forward():
    env = make_env(Task(shortest=1, longest=DELAY, forward=True), worlds=2)
    set_seed(env, 0)
    after = env.rollout(20)["next"]
    env.close()
    torch.testing.assert_close(after[keys.OBSERVATION], after["observation"], atol=1e-5, rtol=0)
    assert not after["received"].allclose(after["observation"], atol=0.01)
