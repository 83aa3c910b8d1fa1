"""The Bayes filter of the source against its slow twin, and whether its probabilities are
frequencies."""

import math

import numpy as np
import pytest
import torch
from belief_twin import belief, chance_at
from helpers import everything, square, walking

from damian import UavEnv
from damian.server.belief import (
    _advance,
    _begin,
    _parts,
    build_source_grid,
    build_source_grids,
    detection_chance,
    empty_window,
    latest,
)
from damian.world.config import SourceConfig

LONGEST = 4


def make_grid(emission=0.6, moves=True, regions=1, **detection):
    """A small grid, over one or several regions."""
    emits = {"emission": "per_step", "emission_probability": emission, **detection}
    airspace = UavEnv(square() if regions == 1 else everything()).simulation.airspace
    source = walking(**emits) if moves else SourceConfig(**emits)
    return build_source_grid(airspace, source, radius=50.0, dt=1.0, cell=45.0)


grids = {
    "one region": make_grid(),
    "always emitting": make_grid(1.0),
    "static": make_grid(1.0, moves=False),
    "several regions": make_grid(regions=3),
    "misses and false alarms": make_grid(miss=0.3, false_alarm=0.1),
    "unlike sources": build_source_grids(
        UavEnv(square()).simulation.airspace,
        [
            walking(emission="per_step", false_alarm=0.1),
            SourceConfig(level_db=138.0),
            walking(miss=0.2),
        ],
        dt=1.0,
        cell=45.0,
    ),
}


@pytest.mark.parametrize(("miss", "alarm"), [(0.0, 0.0), (0.3, 0.1), (0.5, 0.0)])
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


every_grid = pytest.mark.parametrize("grid", grids.values(), ids=grids)


class Flight:
    """Random reports with random delays, in worlds that begin new episodes and pause at random."""

    def __init__(self, grid, n_worlds, own, seed=0):
        self.grid = grid
        self.rng = np.random.default_rng(seed)
        self.n_agents = 3
        self.window = empty_window(grid, LONGEST, n_worlds, self.n_agents, own)
        self.region = self.draw(len(grid.prior), n_worlds)
        self.steps = [[] for _ in range(n_worlds)]
        self.first = torch.zeros(n_worlds, self.n_agents, dtype=torch.long)
        self.begin(torch.ones(n_worlds, dtype=torch.bool))

    def draw(self, below, *shape):
        return torch.as_tensor(self.rng.integers(below, size=shape))

    def rows(self):
        """Reports from landing points of the world's own region; some UAVs send none."""
        per_region = (len(self.grid.log_reports) - 1) // 4 // len(self.grid.prior)
        shape = (len(self.region), self.n_agents)
        point = self.draw(5, *shape) + self.region.unsqueeze(-1) * per_region
        row = 2 * point + (self.draw(3, *shape) == 0)
        return torch.where(self.draw(5, *shape) == 0, self.grid.no_report, row)

    def begin(self, mask):
        new = self.rows()
        self.first = torch.where(mask.unsqueeze(-1), new, self.first)
        _begin(*_parts(self.grid, self.window), new, self.region, mask)
        for world in mask.nonzero().squeeze(-1).tolist():
            self.steps[world] = []

    def step(self, stepped):
        rows = self.rows()
        delay = self.draw(LONGEST + 2, *self.first.shape) - 1
        slot, *_ = _advance(*_parts(self.grid, self.window), rows, delay, self.region, stepped)
        self.window = self.window._replace(slot=slot)
        for world in stepped.nonzero().squeeze(-1).tolist():
            self.steps[world].append((rows[world].tolist(), delay[world].tolist()))

    def check(self):
        """Compare the beliefs of all receivers with the slow twin's."""
        server, own = latest(self.window, self.window.slot)
        for world, steps in enumerate(self.steps):
            of_world = (
                self.grid,
                int(self.region[world]),
                self.first[world].tolist(),
                steps,
                len(steps),
            )
            for viewer, found in enumerate([server[world], *own[world]]):
                expected = torch.tensor(belief(*of_world, viewer - 1 if viewer else None))
                torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-6)


@pytest.mark.sample(2)
@every_grid
@pytest.mark.parametrize("own", [False, True])
def test_beliefs_equal_the_slow_twins_for_any_delays_losses_resets_and_pauses(grid, own):
    flight = Flight(grid, n_worlds=2, own=own)
    for i in range(12):
        flight.step(flight.draw(5, 2) > 0)
        if i % 5 == 4:
            flight.begin(flight.draw(2, 2) == 0)
        if i in (4, 11):
            flight.check()


@every_grid
def test_the_chance_of_a_detection_equals_the_slow_twins(grid):
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
