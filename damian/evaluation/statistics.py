"""Statistics of runs: normalised scores, recovery, interquartile mean, and their bootstrap intervals.

All functions are vectorised over leading dimensions ``*``, so that a statistic takes one sample or all
resamples at once. Higher scores are better. Source of the stratified bootstrap and of the interquartile
mean: Agarwal et al. 2021, arXiv 2108.13264.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from damian.common import checks

Floats = NDArray[np.floating]

LEAST_GAP = 0.1
"""Smallest cost of the delay, as a share of undelayed - random, for which a recovery is reported."""


def normalised(score: Floats, undelayed: Floats, random: Floats) -> Floats:
    """Normalised score (J_norm), ``(J - J_random) / (J_undelayed - J_random)``.

    It is nan where the undelayed arm does not beat random. All arguments broadcast against each other.
    """
    span = np.asarray(undelayed - random, dtype=float)
    return (score - random) / np.where(span > 0, span, np.nan)


def recovery(
    aware: Floats, naive: Floats, undelayed: Floats, random: Floats, least: float = LEAST_GAP
) -> Floats:
    """Share of the delay's cost that a method wins back, ``(aware - naive) / (undelayed - naive)``.

    All scores are means over seeds, and broadcast against each other.

    Args:
        aware: score of the method that takes the delay into account.
        naive: score of the best arm that does not.
        undelayed: score of the arm without delay.
        random: score of the random policy without delay.
        least: smallest ``(undelayed - naive) / (undelayed - random)`` for which there is a recovery.

    Returns:
        the recovery; nan where undelayed - naive is not positive or smaller than ``least`` allows, or where
        undelayed does not beat random.
    """
    gap = np.asarray(undelayed - naive, dtype=float)
    enough = (gap > 0) & (undelayed > random) & (gap >= least * (undelayed - random))
    return (aware - naive) / np.where(enough, gap, np.nan)


def interquartile_mean(values: Floats) -> Floats:
    """Mean of the middle half of the values in the last dimension, [*, K] to [*].

    If K is not a multiple of four, the two outermost values that remain count in part, so that always K / 2
    values are averaged (some libraries round instead).
    """
    n_values = values.shape[-1]
    cut, kept = n_values / 4, n_values / 2
    rank = np.arange(n_values)
    weight = np.clip(np.minimum(rank + 1, n_values - rank) - cut, 0, 1)
    weight *= kept / weight.sum()  # the sum differs from ``kept`` for a single value only
    return (np.sort(values, -1) * weight).sum(-1) / kept


def resampled(scores: Floats, draws: int, seed: int = 0) -> Floats:
    """Draw seeds with replacement, in each stratum separately; all arms of a stratum get the same draws.

    Args:
        scores: scores by seed, [strata, *, seeds]; a stratum is a task with all its arms.
        draws: number of resamples.
        seed: seed of the random draws.

    Returns:
        the resampled scores, [draws, strata, *, seeds].
    """
    checks.whole("draws", draws, 1)
    strata, n_seeds = scores.shape[0], scores.shape[-1]
    drawn = np.random.default_rng(seed).integers(n_seeds, size=(draws, strata, n_seeds))
    between = (1,) * (scores.ndim - 2)
    return np.take_along_axis(scores[None], drawn.reshape(draws, strata, *between, n_seeds), -1)


def interval(values: Floats, level: float = 0.95) -> tuple[Floats, Floats]:
    """Percentile interval of resampled statistics, [draws, *]: its low and high ends, [*] each.

    A nan (a ratio without meaning) counts both as the lowest and as the highest value: an end of the interval
    that falls on a nan is infinite.
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
    """Stratified bootstrap interval of a statistic over seeds: its low and high ends.

    Args:
        statistic: function from scores [*, strata, ..., seeds] to [*, ...], for any leading dimensions *.
        scores: scores by seed, [strata, ..., seeds].
        draws: number of resamples.
        level: share of the resampled statistics inside the interval.
        seed: seed of the random draws.
    """
    return interval(statistic(resampled(scores, draws, seed)), level)
