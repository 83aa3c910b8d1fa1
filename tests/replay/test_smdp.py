"""Decisions and transitions of stored steps, against a loop over steps, worlds and UAVs."""

import itertools

import pytest
import torch
from tensordict import TensorDict

from damian.replay.smdp import find_decisions, transitions

T = 12
B = 5
N = 3


def flags(seed):
    """Random ``ready``, ``ready_next``, ``done`` and ``terminated`` that a rollout could have."""
    torch.manual_seed(seed)
    after = torch.rand(T, B, N) < 0.4
    done = torch.rand(T, B) < 0.1
    ready = torch.cat([torch.ones(1, B, N, dtype=torch.bool), after[:-1]])
    ready[1:] |= done[:-1].unsqueeze(-1)  # after a reset every UAV is ready
    return ready, after, done, done & (torch.rand(T, B) < 0.5)


def find_in_loop(ready, after, done, terminated):
    """Every decision that ends within the steps and is not truncated in flight, found step by
    step."""
    found = set()
    for begin, world, agent in itertools.product(range(T), range(B), range(N)):
        if not ready[begin, world, agent]:
            continue
        for end in range(begin, T):
            if done[end, world] or after[end, world, agent]:
                if after[end, world, agent] or terminated[end, world]:
                    found.add((begin, world, agent, end))
                break
    return found


@pytest.mark.parametrize("seed", range(5))
def test_decisions_are_those_that_a_loop_finds(seed):
    found = torch.stack(find_decisions(*flags(seed)), -1)
    expected = find_in_loop(*flags(seed))
    assert {tuple(row) for row in found.tolist()} == expected
    assert len(found) == len(expected) > 20


def random_steps(seed):
    """Random steps, as a ring buffer holds them whose oldest step lies at index 4."""
    torch.manual_seed(seed)
    agents = {
        "action": torch.rand(T, B, N, 2),
        "observation": torch.rand(T, B, N, 4),
    }
    after = {
        "observation": torch.rand(T, B, N, 4),
        "reward": torch.rand(T, B, N, 1),
    }
    ends = {key: torch.rand(T, B, 1) < 0.3 for key in ("done", "terminated")}
    return TensorDict({"agents": agents, "next": {"agents": after, **ends}}, [T, B])


@pytest.mark.parametrize("team", [0.0, 0.25])
def test_a_transition_has_the_observations_before_and_after_it_and_its_discounted_reward(team):
    steps = random_steps(0)
    order = torch.arange(4, T + 4) % T
    decisions = find_decisions(*flags(0))
    batch = transitions(steps, order, decisions, 0.9, ["observation"], team)
    before = steps[order]
    after = steps["next"][order]
    for k, (begin, world, agent, end) in enumerate(
        zip(*(part.tolist() for part in decisions), strict=True)
    ):
        for key in ("action", "observation"):
            assert batch["agents", key][k].equal(before["agents", key][begin, world, agent])
        observation = after["agents", "observation"][end, world, agent]
        assert batch["next", "agents", "observation"][k].equal(observation)
        for key in ("done", "terminated"):
            assert batch["next", key][k].equal(after[key][end, world])
        earned = after["agents", "reward"][begin : end + 1, world, :, 0]
        rewards = ((1 - team) * earned[:, agent] + team * earned.mean(-1)).tolist()
        expected = sum(0.9**k * reward for k, reward in enumerate(rewards))
        assert batch["next", "agents", "reward"][k].item() == pytest.approx(expected, rel=1e-5)
        assert batch["steps_to_next_obs"][k].item() == end - begin + 1
