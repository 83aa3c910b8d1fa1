"""The scripted policy that reads the belief: where it sends the UAVs for a given belief."""

import pytest
import torch
from helpers import SQUARE, square

from damian import DelayConfig, keys, make_env
from damian.baselines.script import Searcher, script_policy
from damian.server.config import ObservationConfig, RewardConfig
from damian.world.config import ActionConfig, RegionConfig


def believing(own=False, **changed):
    """Three UAVs in the south-west of a square, which fly up to 300 m in 16 directions."""
    region = RegionConfig(
        kind="vertices",
        vertices=SQUARE,
        lattice_step=20.0,
        initial_conditions=1,
        start_positions=[[20.0, 20.0], [40.0, 20.0], [20.0, 40.0]],
    )
    sections = {
        "region": region,
        "observation": ObservationConfig(belief=["belief_moments"], own=own),
        "actions": ActionConfig(
            "discrete", [37.5 * n for n in range(9)], [22.5 * n for n in range(16)]
        ),
    }
    return make_env(square(**(sections | changed)), 1, extras=["message"])


@pytest.mark.parametrize("own", [False, True])
def test_all_uavs_fly_to_where_they_detect_the_source(own):
    env = believing(own=own)
    td = env.reset()
    centres = env.server.grid.centres
    cell = (
        (centres - torch.tensor([50.0, 50.0])).norm(dim=-1).argmin()
    )  # the source certainly is there
    td[keys.BELIEF] = torch.nn.functional.one_hot(cell, len(centres)).float().view(1, 1, -1)
    if own:
        td[keys.OWN_BELIEF] = td[keys.BELIEF].unsqueeze(1).expand_as(td[keys.OWN_BELIEF]).clone()
    after = env.step(script_policy(env)(td))["next"][keys.MESSAGE]
    distance = (env.uav_env.server.messages(after).position[0] - centres[cell]).norm(dim=-1)
    assert (distance < env.uav_env.simulation.radius).all()


def test_without_a_belief_or_a_reward_for_the_source_the_script_keeps_its_own_map():
    scripts = {
        "belief": believing(),
        "late": believing(delay=DelayConfig(obs=2)),
        "none": believing(observation=ObservationConfig()),
        "coverage": believing(reward=RewardConfig(spotted=0.0, coverage=1.0)),
    }
    searches = {
        name: isinstance(script_policy(env).module, Searcher) for name, env in scripts.items()
    }
    assert searches == {"belief": True, "late": True, "none": False, "coverage": False}
