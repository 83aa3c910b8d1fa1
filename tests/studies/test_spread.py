"""The study ``spread``: what late agents observe, what their critics learn from, and the command line."""

import pytest
import spread
import torch
from simple_spread import AGES, DELAYS, HELD, HORIZON, KINEMATICS, SEEN
from spread import ARMS, LATE, make_env, make_learner
from tensordict import TensorDictBase
from torch import Tensor

from damian import keys, set_seed
from damian.learners.networks import ModelConfig

WORLDS = 3


@pytest.fixture(scope="module")
def steps() -> TensorDictBase:
    """Two episodes of the arm ``learnt``, whose agents act at random, [T, B]."""
    torch.manual_seed(0)
    env = make_env(ARMS["learnt"], WORLDS, LATE)
    set_seed(env, 0)
    return env.rollout(2 * HORIZON, break_when_any_done=False).transpose(0, 1)


def sent(steps: TensorDictBase, t: int) -> tuple[Tensor, Tensor]:
    """Messages [B, 15, 2] and delays [B, 15] of the ``t``-th observation of the first episode."""
    if t == 0:
        return steps[SEEN][0], torch.zeros(WORLDS, 15, dtype=torch.long)
    return steps["next", *SEEN][t - 1], steps["next", *DELAYS][t - 1].squeeze(-1)


def newest(steps: TensorDictBase, t: int, world: int, block: int) -> int:
    """When the newest message of a block was sent that has arrived by the ``t``-th observation."""
    arrived = [g for g in range(t + 1) if g + int(sent(steps, g)[1][world, block]) <= t]
    return max(arrived)


def at(steps: TensorDictBase, t: int, key) -> Tensor:
    """An entry of the ``t``-th observation of the first episode."""
    return steps[key][t] if t < HORIZON else steps["next", *key][t - 1]


def test_each_block_is_late_by_itself_and_agents_begin_with_what_they_see_at_the_beginning(steps):
    for t in range(HORIZON + 1):
        for world in range(WORLDS):
            for block in range(15):
                g = newest(steps, t, world, block)
                assert at(steps, t, HELD)[world, block].equal(sent(steps, g)[0][world, block])
                assert at(steps, t, AGES)[world, block] == t - g
    assert steps[HELD][HORIZON].equal(steps[SEEN][HORIZON])  # the next episode
    delays = steps["next", *DELAYS]
    assert delays.unique().tolist() == [3, 4, 5, 6, 7, 8, 9]
    assert (delays != delays[:, :, :1]).any()
    assert steps["next", *keys.DELAY].squeeze(-1).equal(delays.view(-1, WORLDS, 3, 5).amax(-1))


@pytest.fixture
def small(monkeypatch) -> None:
    """Few worlds and small networks."""
    monkeypatch.setattr(spread, "WORLDS", 4)
    monkeypatch.setattr(spread, "MODEL", ModelConfig(hidden=[8]))
    monkeypatch.setattr(spread, "BELIEF", {"prediction_steps": 1, "prediction_batch": 8})


@pytest.mark.parametrize("arm", ["backupdate", "learnt"])
def test_critics_learn_from_what_agents_would_have_seen_without_delay(small, arm):
    env = make_env(ARMS[arm], 4, LATE)
    set_seed(env, 0)
    learner = make_learner(env, ARMS[arm], 1)
    with torch.no_grad():
        batches = env.rollout(3 * HORIZON, learner.actor, break_when_any_done=False).split(HORIZON, 1)
    learner.backupdated_batch(batches[0])
    for batch in batches[1:]:
        late = learner.backupdated_batch(batch)
        seen = late["next", *SEEN].view(4, HORIZON, 3, 10)
        undelayed = torch.cat([late["next", *KINEMATICS], seen, torch.eye(3).expand(4, HORIZON, 3, 3)], -1)
        assert late["next", *keys.GLOBAL_OBSERVATION].equal(undelayed)
        assert not late["next", *keys.OBSERVATION][..., :17].equal(undelayed)
