"""The study ``heading``: a filter over pairs of a class of velocity and a cell."""

import torch
from heading import DIRECTIONS, flown, velocity_grid

from damian.recipes.shared.environments import compose_scenario
from damian.server.belief import build_source_grid

SCENARIO = compose_scenario("scenario=delaybench/tracking", "observation.belief=[belief_moments]")


def test_the_filter_with_velocity_is_a_chain_over_the_cells_of_the_built_in_one():
    grids = []

    def both(*arguments):
        grids.extend(build(*arguments) for build in (build_source_grid, velocity_grid))
        return grids[-1]

    returned, log_probability = flown(SCENARIO, both, worlds=4, seed=0)
    place, velocity = grids
    n_cells, n_kinds = len(place.centres), 1 + DIRECTIONS
    assert velocity.centres.view(n_kinds, n_cells, 2).equal(place.centres.expand(n_kinds, -1, -1))
    torch.testing.assert_close(velocity.prior.view(n_kinds, n_cells).sum(0), place.prior[0])
    torch.testing.assert_close(velocity.moves[0].sum(-1), torch.ones(n_kinds * n_cells))
    # From the middle, at rest a source stays nearer than in flight, and to the east it goes east.
    middle = place.centres.square().sum(-1).argmin()
    mean = velocity.moves.view(n_kinds, n_cells, n_kinds, n_cells)[:, middle].sum(1) @ place.centres
    assert (mean[1:] - place.centres[middle]).norm(dim=-1).min() > (mean[0] - place.centres[middle]).norm()
    assert (mean[1] - place.centres[middle])[0] > 0
    assert 0 < returned < 50
    assert log_probability < 0
