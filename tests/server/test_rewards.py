"""Terms used again, and ends of episodes, which equal those of plain loops."""

import numpy as np
import torch
import twin
from helpers import messages_of, random_worlds
from hypothesis import given, strategies as st

from damian.server.config import BUILT_IN
from damian.server.rewards import Counters, RewardConfig, reward, terms_of
from damian.server.termination import EpisodeConfig, status

shares = st.sampled_from([None, 0.1, 1 / 3, 0.5, 0.9, 1.0])


def test_a_built_in_term_can_be_used_again_with_parameters_of_its_own():
    again = {"term": "mean_distance", "weight": 2.0, "name": "close", "desired_distance": 0.2}
    unused = {"term": "battery", "weight": 0.0, "name": "unused"}
    task = RewardConfig(spotted=0.0, mean_distance=1.0, custom=[again, unused])
    inputs = {name: torch.rand(2, 3) for name in BUILT_IN}
    counters = Counters(
        torch.ones(2), motions=torch.ones(2, 3), news=torch.ones(2, 3, dtype=torch.bool)
    )
    ours = reward(inputs, counters, terms_of(task))
    assert [*ours] == task.terms == ["mean_distance", "close"]
    near = RewardConfig(spotted=0.0, mean_distance=2.0, desired_distance=0.2)
    assert ours["close"].equal(reward(inputs, counters, terms_of(near))["mean_distance"])
    assert not ours["close"].equal(2 * ours["mean_distance"])


@given(
    seed=st.integers(0, 2**32 - 1),
    n_agents=st.integers(1, 5),
    success=shares,
    discharged=shares,
    max_steps=st.sampled_from([None, 1, 5, 20]),
    since=st.booleans(),
)
def test_every_end_of_an_episode_equals_that_of_a_plain_loop(
    seed, n_agents, success, discharged, max_steps, since
):
    episode = EpisodeConfig(max_steps, since, success, discharged)
    rng = np.random.default_rng(seed)
    worlds = random_worlds(seed, n_agents, 0.7, 0.6, n_worlds=6)
    dt = float(rng.choice([1.0, 0.5]))
    steps = rng.integers(1, 40, 6)
    worlds = [(float(n * dt), uavs) for n, (_, uavs) in zip(steps, worlds, strict=True)]
    for now, uav in [
        (now, uav) for now, uavs in worlds for uav in uavs if uav.heard_at is not None
    ]:
        # All detections happen at the end of a step.
        uav.heard_at = now if uav.spots else float(rng.integers(round(now / dt) + 1)) * dt
    messages, _ = messages_of(worlds)
    over = torch.zeros(6, dtype=torch.bool)
    ours = status(messages, torch.as_tensor(steps), over, dt, episode)
    expected = [
        twin.end(uavs, int(n), now, dt, episode)
        for n, (now, uavs) in zip(steps, worlds, strict=True)
    ]
    assert list(zip(*(flag.tolist() for flag in ours), strict=True)) == expected
    assert not (ours.terminated & ours.truncated).any()
