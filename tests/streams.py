"""A check that random streams are independent, which fails for shared and for shifted streams."""

import torch

from damian.common import counter_rng

N_DRAWS = 4000


def overlaps(draws):
    """Number of draws that occur more than once among all draws of all streams."""
    _, counts = draws.flatten().unique(return_counts=True)
    return int((counts > 1).sum())


def check_independent(streams):
    """Check the draws of all streams [M] beside each other, in the same step and one step apart."""
    clock = torch.arange(N_DRAWS)
    assert overlaps(counter_rng.bits64(streams.unsqueeze(-1), clock)) == 0
    draws = counter_rng.uniform(streams.unsqueeze(-1), clock).double()
    m = len(streams)
    for lag in (0, 1):
        both = torch.cat([draws[:, lag:], draws[:, : N_DRAWS - lag]])
        correlation = torch.corrcoef(both)[:m, m:] * (N_DRAWS - lag) ** 0.5  # about normal(0, 1)
        apart = correlation if lag else correlation[~torch.eye(m, dtype=torch.bool)]
        assert apart.abs().max() < 5.5
    assert (draws.mean(-1) - 0.5).abs().max() < 5.5 * (1 / 12 / N_DRAWS) ** 0.5
