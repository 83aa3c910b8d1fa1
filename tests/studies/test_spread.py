"""The study ``spread``: what late agents observe, and what their critics learn from."""

from itertools import product

import pytest
import spread
import torch
from particles import DELAYS, HELD, HORIZON, KINEMATICS, SEEN
from spread import METHODS, SLOTS, make_env, make_learner

from damian import keys, set_seed
from damian.models.config import MlpConfig
from damian.models.memory import add_recurrent_state

WORLDS = 3
LATE = (3, 9)


def flown(method):
    """Two episodes of a method whose agents act at random, [T, B]."""
    torch.manual_seed(0)
    env = make_env(METHODS[method], WORLDS, LATE, 9)
    set_seed(env, 0)
    return env.rollout(2 * HORIZON, break_when_any_done=False).transpose(0, 1)


@pytest.fixture(scope="module")
def steps():
    return flown("registered+backupdate")


def sent(steps, t):
    """Messages [B, 15, 2] and delays [B, 15] of the ``t``-th observation of the first episode."""
    if t == 0:
        return steps[SEEN][0], torch.zeros(WORLDS, 15, dtype=torch.long)
    return steps["next", *SEEN][t - 1], steps["next", *DELAYS][t - 1].squeeze(-1)


def newest(steps, t, world, block):
    """When the newest message of a block was sent that has arrived by the ``t``-th observation."""
    arrived = [g for g in range(t + 1) if g + int(sent(steps, g)[1][world, block]) <= t]
    return max(arrived)


def at(steps, t, key):
    """An entry of the ``t``-th observation of the first episode."""
    return steps[key][t] if t < HORIZON else steps["next", *key][t - 1]


def test_each_block_is_late_by_itself_and_agents_begin_with_what_they_see_at_the_beginning(steps):
    assert steps[HELD][HORIZON].equal(steps[SEEN][HORIZON])  # the next episode
    delays = steps["next", *DELAYS]
    assert delays.unique().tolist() == [3, 4, 5, 6, 7, 8, 9]
    assert (delays != delays[:, :, :1]).any()
    assert steps["next", *keys.DELAY].squeeze(-1).equal(delays.view(-1, WORLDS, 3, 5).amax(-1))


def test_what_is_registered_stands_where_it_was_as_seen_from_where_the_agent_is_now():
    held = flown("registered")
    others = ([1, 2], [0, 2], [0, 1])
    for t, world, agent, i in product(range(HORIZON + 1), range(WORLDS), range(3), range(2)):
        found = at(held, t, keys.OBSERVATION)[world, agent, 4:14].view(5, 2)[3 + i]
        then = newest(held, t, world, 5 * agent + 3 + i)
        was = at(held, then, KINEMATICS)[world, others[agent][i], 2:]
        way = was - at(held, t, KINEMATICS)[world, agent, 2:]  # to the other one, from here and now
        torch.testing.assert_close(found, way)


@pytest.fixture
def small(monkeypatch):
    """Few worlds and small networks."""
    monkeypatch.setattr(spread, "WORLDS", 4)
    monkeypatch.setattr(spread, "MODEL", MlpConfig(hidden=[8]))


def corrected(method):
    """What the learner of a method learns from, [B, T] each, and [B, T, N, 4 + C + N] for its
    critic."""
    env = make_env(METHODS[method], 4, LATE, 9)
    set_seed(env, 0)
    learner = make_learner(env, METHODS[method], 9)
    add_recurrent_state(env, learner.actor)
    with torch.no_grad():
        batches = env.rollout(3 * HORIZON, learner.actor, break_when_any_done=False).split(
            HORIZON, 1
        )
    return [learner.backupdated_batch(batch) for batch in batches][1:]


@pytest.mark.parametrize(
    "method", ["backupdate", "registered+backupdate+gru", "timeline+backupdate"]
)
def test_critics_learn_from_what_agents_would_have_seen_without_delay(small, method):
    for late in corrected(method):
        kinematics = late["next", *KINEMATICS]
        critic = late["next", *keys.GLOBAL_OBSERVATION]
        seen = late["next", *SEEN].unflatten(2, (3, 5))
        if "registered" in method:
            seen = seen - kinematics[..., 2:].unsqueeze(-2)
        if "timeline" in method:
            slots = critic[..., 4:-3].unflatten(-1, (5, SLOTS, 3))
            known = torch.arange(SLOTS) <= late["next", "step_count"]
            assert slots[..., 2].bool().equal(known[:, :, None, None].expand(slots.shape[:-1]))
            landmarks = slots[..., :3, :, :2]  # they rest, in whichever step they were seen
            expected = landmarks[..., :1, :] * known[:, :, None, None, :, None]
            torch.testing.assert_close(landmarks, expected)
            critic = torch.cat(
                [critic[..., :4], slots[..., 0, :2].flatten(-2), critic[..., -3:]], -1
            )
        undelayed = torch.cat(
            [kinematics, seen.flatten(-2), torch.eye(3).expand(4, HORIZON, 3, 3)], -1
        )
        assert critic.equal(undelayed)
        assert not late[keys.OBSERVATION][:, 1:, :, :17].equal(undelayed[:, :-1])


def test_a_prey_is_seen_late_in_the_frame_of_now():
    steps = make_env(METHODS["registered"], WORLDS, (4, 4), 9, "tag").rollout(HORIZON - 1)["next"]
    prey = steps[keys.OBSERVATION][..., 4 : 4 + 12].unflatten(-1, (6, 2))[..., 4, :]
    sent = steps[SEEN].unflatten(2, (3, 6))[..., 4, :]  # registered: a place in the plane
    torch.testing.assert_close(prey[:, 4:], sent[:, :-4] - steps[KINEMATICS][:, 4:, :, 2:])
    assert (sent[:, 1:] - sent[:, :-1]).norm(dim=-1).max() > 0.01  # it flees


def test_a_jitter_buffer_holds_each_message_until_it_is_as_old_as_the_longest_delay_in_training():
    method = METHODS["buffer"]
    for delay, longest in (((3, 9), 9), ((0, 0), 9), ((12, 12), 12)):
        steps = make_env(method, WORLDS, delay, 9).rollout(HORIZON - 1)
        assert steps["next", *DELAYS].unique().tolist() == [longest]
