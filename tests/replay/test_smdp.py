"""Decisions among stored steps, beside a loop over steps, worlds and UAVs."""

import itertools

import pytest
import torch
from tensordict import TensorDict

from damian.replay.smdp import Decisions, find_decisions, transitions

T, B, N = 12, 5, 3


def flags(seed: int):
    """Readiness before and after each step, and ends of episodes, as a flight would have them."""
    torch.manual_seed(seed)
    after, done = torch.rand(T, B, N) < 0.4, torch.rand(T, B) < 0.1
    ready = torch.cat([torch.ones(1, B, N, dtype=torch.bool), after[:-1]])
    ready[1:] |= done[:-1].unsqueeze(-1)  # a reset begins with everybody ready
    return ready, after, done, done & (torch.rand(T, B) < 0.5)


def loop(ready, after, done, terminated, n_decisions):
    """Every decision that ends in time, and not in flight at a time limit, step by step."""
    found = set()
    for begin, world, agent in itertools.product(range(T), range(B), range(N)):
        if not ready[begin, world, agent]:
            continue
        end, left = begin, n_decisions
        while end < T:
            over = done[end, world]
            left -= int(over or after[end, world, agent])
            if over or left == 0:
                if after[end, world, agent] or terminated[end, world]:
                    found.add((begin, world, agent, end))
                break
            end += 1
    return found


@pytest.mark.parametrize("n_decisions", [1, 2, 4])
@pytest.mark.parametrize("seed", range(5))
def test_each_decision_lasts_until_the_next_or_the_end_as_a_loop_finds(n_decisions, seed):
    found = torch.stack(find_decisions(*flags(seed), n_decisions), -1)
    expected = loop(*flags(seed), n_decisions)
    assert {tuple(row) for row in found.tolist()} == expected
    assert len(found) == len(expected) > 20


def test_without_flights_every_step_but_the_last_ones_is_a_decision():
    yes = torch.ones(T, B, N, dtype=torch.bool)
    no = torch.zeros(T, B, dtype=torch.bool)
    found = find_decisions(yes, yes, no, no, 3)
    assert (found.end - found.begin == 2).all()
    assert len(found.begin) == (T - 2) * B * N


def stored(seed: int) -> TensorDict:
    """Steps in the order of a ring that has gone round: the first lies at place 4."""
    torch.manual_seed(seed)
    agents = {"action": torch.rand(T, B, N, 2), "observation": torch.rand(T, B, N, 4)}
    after = {"observation": torch.rand(T, B, N, 4), "reward": torch.rand(T, B, N, 1)}
    ends = {key: torch.rand(T, B, 1) < 0.3 for key in ("done", "terminated")}
    return TensorDict({"agents": agents, "next": {"agents": after, **ends}}, [T, B])


def test_a_transition_holds_what_was_seen_before_it_and_after_it_and_what_it_earned():
    steps, order = stored(0), torch.arange(4, T + 4) % T
    decisions = find_decisions(*flags(0), 2)
    made = transitions(steps, order, decisions, 0.9, ["observation"])
    by_time, later = steps[order], steps["next"][order]
    for k, (begin, world, agent, end) in enumerate(zip(*(part.tolist() for part in decisions), strict=True)):
        for key in ("action", "observation"):
            assert made["agents", key][k].equal(by_time["agents", key][begin, world, agent])
        seen = later["agents", "observation"][end, world, agent]
        assert made["next", "agents", "observation"][k].equal(seen)
        for key in ("done", "terminated"):
            assert made["next", key][k].equal(later[key][end, world])
        rewards = later["agents", "reward"][begin : end + 1, world, agent, 0].tolist()
        earned = sum(0.9**k * reward for k, reward in enumerate(rewards))
        assert made["next", "agents", "reward"][k].item() == pytest.approx(earned, rel=1e-5)
        assert made["steps_to_next_obs"][k].item() == end - begin + 1


def test_a_flight_of_three_steps_by_hand():
    steps = stored(1)
    steps["next", "agents", "reward"][2:5, 1, 0, 0] = torch.tensor([1.0, 2.0, 4.0])
    one = Decisions(*(torch.tensor([number]) for number in (2, 1, 0, 4)))
    made = transitions(steps, torch.arange(T), one, 0.5, [])
    assert made["next", "agents", "reward"].item() == 1 + 2 / 2 + 4 / 4
    assert made["steps_to_next_obs"].item() == 3


def test_each_of_them_may_be_drawn_and_nothing_else():
    found = find_decisions(*flags(2))
    rows = {tuple(row) for row in torch.stack(found, -1).tolist()}
    drawn = {tuple(row) for row in torch.stack(found.sample(5000), -1).tolist()}
    assert drawn == rows
