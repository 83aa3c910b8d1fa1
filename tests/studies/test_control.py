"""The study ``control``: SAC on Pendulum-v1 with the delay transforms."""

import pytest
import torch
from control import Task, draw, make_env, make_learner, train
from tqdm import tqdm

from damian import keys, set_seed
from damian.learners.sac import Sac

DELAY = 3


def trained(task: Task, bpql: bool) -> Sac:
    """The learner of a method after 20 steps with random actions."""
    torch.manual_seed(0)
    env = make_env(task)
    set_seed(env, 0)
    learner = make_learner(env, bpql, 1000, task.longest, 8)
    train(env, learner, 20, tqdm(disable=True))
    return learner


@pytest.mark.parametrize(("bpql", "waits"), [(False, 0), (True, DELAY)])
def test_bpql_alone_waits_until_the_observation_after_a_step_has_arrived(bpql, waits):
    learner = trained(Task(shortest=DELAY, longest=DELAY, history=DELAY), bpql)
    learner.buffer.storage.steps["next", *keys.REWARD][:20] = torch.arange(20.0).view(20, 1, 1)
    drawn = draw(learner)["next", *keys.REWARD].unique()
    assert drawn.tolist() == [*range(20 - waits)]
    read = keys.GLOBAL_OBSERVATION if bpql else keys.OBSERVATION
    assert learner.loss.qvalue_network.in_keys == [read, keys.ACTION]


def test_critics_of_timelines_read_what_was_true_when_and_actors_what_had_arrived_of_it():
    slots = DELAY + 1
    learner = trained(Task(shortest=1, longest=DELAY, history=DELAY, slots=slots), True)
    steps = learner.buffer.storage.steps[: 20 - DELAY, 0]
    sent = torch.cat([steps["observation"][:1], steps["next", "observation"]])
    critic, actor = (
        torch.cat([steps[key][:1], steps["next", *key]])[:, : 4 * slots].view(-1, slots, 4)
        for key in (keys.GLOBAL_OBSERVATION, keys.OBSERVATION)
    )
    for t in range(1, len(sent)):
        for k in range(slots):
            known = torch.cat([sent[t - k], torch.ones(1)]) if k <= t else torch.zeros(4)
            assert critic[t, k].equal(known)
            assert actor[t, k].equal(known) or not actor[t, k].any()
        assert not actor[t, 0].any()
        assert actor[t, DELAY].equal(critic[t, DELAY])


def test_a_jitter_buffer_shows_observations_as_old_as_the_longest_delay():
    steps = make_env(Task(shortest=1, longest=DELAY, buffer=True)).rollout(8)["next"]
    assert steps["age"].flatten().tolist() == [1, 2, 3, 3, 3, 3, 3, 3]
