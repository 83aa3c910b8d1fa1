"""The study ``on_time``: the script with ever more known on time."""

from itertools import pairwise

import pytest
import torch
from on_time import script_rows, true_belief

from damian import keys
from damian.envs.config import ScenarioConfig
from damian.envs.pipeline import make_env
from damian.recipes.cli import settings
from damian.server.features import ObservationConfig
from damian.world.regions.sources import RegionConfig
from damian.world.signal_source import SourceConfig

WORDS = ["scenario=delaybench/tracking", "observation.belief_cell=60", "eval_episodes=300"]
WORDS += ["episode.max_steps=25", "delay.obs=6"]


@pytest.mark.slow
def test_who_knows_more_on_time_wins_more():
    returns = [row.return_ for row in script_rows(settings(*WORDS)).values()]
    assert len(returns) == 4
    assert all(less < more for less, more in pairwise(returns)), returns


def test_the_true_belief_is_certain_of_the_cell_with_the_nearest_centre():
    scenario = ScenarioConfig(
        region=RegionConfig(kind="random", pool=3, lattice_step=40),
        source=SourceConfig(motion="dynamic"),
        observation=ObservationConfig(belief=["belief_moments"]),
    )
    env = make_env(scenario, 12, seed=0, extras=["message", "state"])
    steps = env.rollout(5, break_when_any_done=False)[:, -1]
    grid = env.server.grid
    belief = true_belief(env)(steps.clone())[keys.BELIEF].squeeze(1)
    assert torch.equal(belief.sum(-1), torch.ones(12))
    region = env.server.region_of(env.server.messages(steps[keys.MESSAGE]))
    for world in range(12):
        cells = [k for k in range(belief.shape[-1]) if grid.prior[region[world], k] > 0]
        east, north = steps[keys.STATE][world, -2:].tolist()
        nearest = min(
            cells, key=lambda k: (grid.centres[k, 0] - east) ** 2 + (grid.centres[k, 1] - north) ** 2
        )
        assert belief[world].argmax() == nearest
