"""The probabilities of a source's reports, against all cases and the slow twin; the filter itself:
transforms/test_belief_transform.py."""

import math

import pytest
import torch
from belief_twin import chance_at
from helpers import everything, square, walking

from damian import UavEnv
from damian.server.belief import build_source_grid, build_source_grids, detection_chance
from damian.world.config import SourceConfig


def make_grid(emission=0.6, moves=True, regions=1, **detection):
    """A small grid, over one or several regions."""
    emits = {"emission": "per_step", "emission_probability": emission, **detection}
    airspace = UavEnv(square() if regions == 1 else everything()).simulation.airspace
    source = walking(**emits) if moves else SourceConfig(**emits)
    return build_source_grid(airspace, source, radius=50.0, dt=1.0, edge=45.0)


GRIDS = {
    "one region": make_grid,
    "static": lambda: make_grid(1.0, moves=False),
    "several regions": lambda: make_grid(regions=3),
    "misses and false alarms": lambda: make_grid(miss=0.3, false_alarm=0.1),
    "unlike sources": lambda: build_source_grids(
        UavEnv(square()).simulation.airspace,
        [
            walking(emission="per_step", false_alarm=0.1),
            SourceConfig(level_db=138.0),
            walking(miss=0.2),
        ],
        dt=1.0,
    ),
}


@pytest.mark.parametrize(
    ("miss", "alarm"),
    [
        (0.0, 0.0),
        (0.3, 0.1),
        (0.5, 0.0),
    ],
)
def test_reports_of_a_source_that_stays_have_the_probabilities_of_all_cases(miss, alarm):
    emission = 0.6
    grid = make_grid(emission, moves=False, miss=miss, false_alarm=alarm)
    plain = make_grid(emission, moves=False)
    half = grid.no_report // 2
    for row in range(0, half, 17):
        for cell in range(0, grid.prior.shape[1], 5):
            share = math.exp(float(plain.log_reports[row // 2 * 2 + 1, cell]))
            now = 0.0
            both = 0.0
            before = 0.0
            for covered, weight in ((True, share), (False, 1 - share)):
                heard = 1 - miss if covered else alarm
                fits = (
                    heard if row % 2 else 1 - heard
                )  # while it emits; before, it may have been silent
                quiet = alarm if row % 2 else 1 - alarm
                earlier = emission * fits + (1 - emission) * quiet
                now = now + weight * fits
                before = before + weight * earlier
                both += weight * fits * earlier
            assert grid.log_reports[row, cell].exp().item() == pytest.approx(now, rel=1e-4)
            assert grid.log_reports[row + half, cell].exp().item() == pytest.approx(
                both / before, rel=1e-4
            )


@pytest.mark.parametrize("name", GRIDS)
def test_the_chance_of_a_detection_equals_the_slow_twins(name):
    grid = GRIDS[name]()
    n_regions, n_cells = grid.prior.shape
    n_points = (len(grid.log_reports) - 1) // 4 // n_regions
    region = torch.arange(n_regions)
    beliefs = torch.rand(n_regions, n_cells) * (grid.prior > 0)
    beliefs = beliefs / beliefs.sum(-1, keepdim=True)
    chance = detection_chance(grid, beliefs, region)
    for r in range(n_regions):
        for p in (0, 3, n_points - 1):
            expected = chance_at(grid, r, beliefs[r], r * n_points + p)
            assert chance[r, p].item() == pytest.approx(expected, rel=1e-4)
