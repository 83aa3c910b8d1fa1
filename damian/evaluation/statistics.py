"""How runs are summed up: recovery, normalised scores, interquartile mean, and their bootstrap intervals.

Everything is vectorised over leading dimensions ``*``, so that a statistic takes one sample or all
resamples at once. Scores: higher is better. Source: Agarwal et al. 2021, arXiv 2108.13264, for the
stratified bootstrap and the interquartile mean.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from damian.common import checks

Floats = NDArray[np.floating]

LEAST_GAP = 0.1
"""Of undelayed - random: with a smaller cost of the delay there is nothing to recover."""


def normalised(score: Floats, undelayed: Floats, random: Floats) -> Floats:
    """``(J - J_random) / (J_undelayed - J_random)``; nan where the undelayed arm does not beat random.

    All arguments broadcast against each other.
    """
    span = np.asarray(undelayed - random, dtype=float)
    return (score - random) / np.where(span > 0, span, np.nan)


def recovery(
    aware: Floats, naive: Floats, undelayed: Floats, random: Floats, least: float = LEAST_GAP
) -> Floats:
    """``(aware - naive) / (undelayed - naive)`` of means over seeds, all broadcast against each other.

    Args:
        aware: of the method that knows of the delay.
        naive: of the stronger arm that does not.
        undelayed: of the arm without delay.
        random: of the random policy without delay.
        least: smallest ``(undelayed - naive) / (undelayed - random)`` to make sense of.

    Returns:
        nan where the gap is not positive or smaller than that, or where random beats undelayed.
    """
    gap = np.asarray(undelayed - naive, dtype=float)
    enough = (gap > 0) & (undelayed > random) & (gap >= least * (undelayed - random))
    return (aware - naive) / np.where(enough, gap, np.nan)


def interquartile_mean(values: Floats) -> Floats:
    """Mean of the middle half of the last dimension, [*, K] to [*].

    With K not a multiple of four, the two outermost values that stay count in part, so that always K / 2
    values are averaged (some libraries round instead).
    """
    n_values = values.shape[-1]
    cut, kept = n_values / 4, n_values / 2
    place = np.arange(n_values)
    weight = np.clip(np.minimum(place + 1, n_values - place) - cut, 0, 1)
    weight *= kept / weight.sum()  # of a single value, all of it
    return (np.sort(values, -1) * weight).sum(-1) / kept


def resampled(scores: Floats, draws: int, seed: int = 0) -> Floats:
    """Draw seeds with replacement, in each stratum by itself; all arms of a stratum get the same ones.

    Args:
        scores: [strata, *, seeds]; a stratum is what shares its seeds: a task, with all its arms.
        draws: resamples.
        seed: of the draws.

    Returns:
        [draws, strata, *, seeds].
    """
    checks.whole("draws", draws, 1)
    strata, n_seeds = scores.shape[0], scores.shape[-1]
    drawn = np.random.default_rng(seed).integers(n_seeds, size=(draws, strata, n_seeds))
    between = (1,) * (scores.ndim - 2)
    return np.take_along_axis(scores[None], drawn.reshape(draws, strata, *between, n_seeds), -1)


def interval(values: Floats, level: float = 0.95) -> tuple[Floats, Floats]:
    """Percentile interval of resampled statistics, [draws, *] to two [*].

    A nan (there a ratio has no meaning) counts as lowest and as highest: an end that falls on one is
    infinite.
    """
    unknown, tail = np.isnan(values), (1 - level) / 2
    low = np.quantile(np.where(unknown, -np.inf, values), tail, 0, method="inverted_cdf")
    high = np.quantile(np.where(unknown, np.inf, values), 1 - tail, 0, method="inverted_cdf")
    return low, high


def bootstrap(
    statistic: Callable[[Floats], Floats],
    scores: Floats,
    draws: int = 2000,
    level: float = 0.95,
    seed: int = 0,
) -> tuple[Floats, Floats]:
    """Stratified bootstrap interval over seeds of what ``statistic`` makes of ``[*, strata, ..., seeds]``.

    Args:
        statistic: from any leading dimensions * to the same, [*, ...].
        scores: [strata, ..., seeds].
        draws: resamples.
        level: share of the resamples inside.
        seed: of the draws.
    """
    return interval(statistic(resampled(scores, draws, seed)), level)
