"""Statistics of runs, vectorised over leading dimensions ``*``; higher scores are better."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

Floats = NDArray[np.floating]

LEAST_GAP = 0.1
"""Smallest cost of the delay, as a share of undelayed - random, for which a recovery is
reported."""
FEWEST = 3
"""Smallest number of seeds for which there is an interval."""
LEVEL = 0.95
"""Share of the resampled statistics inside an interval, before it is widened."""
NORMAL = float(stdtrit(100_000, (1 + LEVEL) / 2))
"""End of the interval that holds this share of a normal distribution
(of Student's, with many degrees of freedom, as the published tables have it)."""


def normalised(score: Floats, undelayed: Floats, random: Floats) -> Floats:
    """Normalised score (J_norm), ``(J - J_random) / (J_undelayed - J_random)``.

    It is nan where the undelayed method does not beat random. All arguments broadcast against each
    other.
    """
    span = np.asarray(undelayed - random, dtype=float)
    return (score - random) / np.where(span > 0, span, np.nan)


def recovery(scores: Floats, least: float = LEAST_GAP) -> Floats:
    """Share of the delay's cost that a method wins back, ``(aware - naive) / (undelayed - naive)``.

    Scores are [*, methods, seeds], of undelayed, random, naive methods, and the aware one, to [*];
    all are means over seeds, and naive is the best. It is nan where undelayed - naive is not
    positive or less than ``least`` of undelayed - random, or where undelayed does not beat random.
    """
    means = scores.mean(-1)
    undelayed = means[..., 0]
    random = means[..., 1]
    naive = means[..., 2:-1].max(-1)
    gap = undelayed - naive
    span = undelayed - random
    enough = (gap > 0) & (span > 0) & (gap >= least * span)
    gain = means[..., -1] - naive
    return gain / np.where(enough, gap, np.nan)


def resampled(scores: Floats, draws: int) -> Floats:
    """Draw seeds with replacement, the same for all, [*, methods, seeds] to
    [draws, *, methods, seeds]."""
    n_seeds = scores.shape[-1]
    drawn = np.random.default_rng(0).integers(n_seeds, size=(draws, n_seeds))
    return np.moveaxis(scores[..., drawn], -2, 0)


def interval(values: Floats) -> tuple[Floats, Floats]:
    """Percentile interval of resampled statistics, [draws, *]: its low and high ends, [*] each.

    A nan (a ratio without meaning) counts both as the lowest and as the highest value: an end of
    the interval that falls on a nan is infinite.
    """
    unknown = np.isnan(values)
    tail = (1 - LEVEL) / 2
    quantile = partial(np.quantile, axis=0, method="inverted_cdf")
    lowest = np.where(unknown, -np.inf, values)
    highest = np.where(unknown, np.inf, values)
    return quantile(lowest, tail), quantile(highest, 1 - tail)


def probability_of_improvement(scores: Floats, others: Floats) -> Floats:
    """Probability that a run of one method beats a run of another, [*], from scores by seed,
    [*, seeds] each.

    It is the share of all pairs of runs in which the first has the higher score; equal scores count
    half.
    """
    difference = scores[..., :, None] - others[..., None, :]
    wins = (np.sign(difference) + 1) / 2
    return wins.mean((-2, -1))


def improvement_interval(probability: float, n_seeds: int) -> tuple[float, float]:
    """Score interval of a ``probability_of_improvement`` between two methods with as many seeds
    each.

    It has every probability from which the one that was found differs by no more than chance allows
    (Newcombe 2006, method 5, https://doi.org/10.1002/sim.2324), also where every run beats every
    other one, for which a bootstrap has no width. With fewer than ``FEWEST`` seeds both ends are
    nan.
    """
    if n_seeds < FEWEST or math.isnan(probability):
        return math.nan, math.nan
    truth = np.linspace(0, 1, 10_001)
    shared = (1 - truth) / (2 - truth) + truth / (1 + truth)
    variance = truth * (1 - truth) * (1 + (n_seeds - 1) * shared)
    chance = NORMAL * np.sqrt(variance) / n_seeds
    likely = truth[np.abs(truth - probability) <= chance]
    return float(likely.min()), float(likely.max())


def bootstrap(
    statistic: Callable[[Floats], Floats], scores: Floats, draws: int = 2000
) -> tuple[Floats, Floats, Floats]:
    """A statistic over seeds, and the low and high ends of its bootstrap interval.

    For the mean of few seeds, the interval of the resampled statistics (``interval``) is too
    narrow: of those for 95 %, only 83 % contain the truth with 5 seeds, and 88 % with 10. So both
    ends are moved away from the statistic by the factor by which Student's interval of a mean is
    wider than the normal one without correction for bias. With fewer than ``FEWEST`` seeds both
    ends are nan.

    Args:
        statistic: function from scores [*, methods, seeds] to [*, ...], for any leading dimensions
            *.
        scores: scores by seed, [methods, seeds].
        draws: number of resamples.
    """
    value = np.asarray(statistic(scores), dtype=float)
    n_seeds = scores.shape[-1]
    if n_seeds < FEWEST:
        unknown = np.full_like(value, np.nan)
        return value, unknown, unknown
    degrees = n_seeds - 1
    bias = math.sqrt(n_seeds / degrees)
    student = stdtrit(degrees, (1 + LEVEL) / 2)
    factor = bias * student / NORMAL
    low, high = interval(statistic(resampled(scores, draws)))
    below = factor * (value - low)
    above = factor * (high - value)
    return value, value - below, value + above
