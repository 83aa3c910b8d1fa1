"""The statistics of comparisons, against closed forms and slow, obvious implementations."""

import itertools
import math

import numpy as np
import pytest

from damian.compare.statistics import (
    bootstrap,
    improvement_interval,
    interval,
    probability_of_improvement,
    recovery,
    resampled,
)


@pytest.mark.parametrize(
    ("naive", "defined"),
    [
        (8.0, True),
        (9.0, True),
        (9.01, False),
        (10.0, False),
        (11.0, False),
    ],
)
def test_recovery_is_nan_if_the_delay_costs_less_than_a_tenth(naive, defined):
    scores = np.array([[10.0], [0.0], [naive], [9.5]])
    assert np.isnan(recovery(scores)) == (not defined)


def exact_interval(values, weights):
    """The 95 % percentile interval of a discrete distribution with these values and weights."""
    total = 0.0
    low = math.nan
    high = math.nan
    for value, weight in sorted(zip(values, weights, strict=True)):
        total += weight
        low = value if math.isnan(low) and total >= 0.025 else low
        high = value if math.isnan(high) and total >= 0.975 else high
    return low, high


def test_the_interval_of_a_recovery_equals_that_over_all_possible_draws():
    aware, naive, undelayed = np.array([[3.0, 4.0, 8.0], [1.0, 0.0, 2.0], [9.0, 7.0, 10.0]])
    ratios = []
    for draw in itertools.product(range(3), repeat=3):
        a, n, u = (float(np.mean(method[list(draw)])) for method in (aware, naive, undelayed))
        ratios.append((a - n) / (u - n))
    methods = np.stack([undelayed, np.zeros(3), naive, aware])
    low, high = interval(recovery(resampled(methods, draws=20_000), 0.0))
    np.testing.assert_allclose((low, high), exact_interval(ratios, [3**-3] * 27), rtol=1e-12)


@pytest.mark.parametrize("n_seeds", [3, 5, 10])
def test_95_percent_intervals_contain_the_truth_in_95_percent_of_all_experiments(n_seeds):
    experiments = np.random.default_rng(1).normal(7.0, 2.0, size=(4000, n_seeds))
    _, low, high = bootstrap(lambda scores: scores.mean(-1), experiments, draws=500)
    covered = ((low < 7) & (high > 7)).mean()
    assert 0.94 < covered < 0.97, covered


@pytest.mark.parametrize("n_seeds", [3, 5, 10])
@pytest.mark.parametrize("shift", [0.5, 1.0, 2.0, 3.0])
def test_the_interval_of_an_improvement_contains_the_truth_in_95_percent_of_all_experiments(
    n_seeds, shift
):
    ours, theirs = np.random.default_rng(1).normal(size=(2, 2000, n_seeds))
    found = probability_of_improvement(ours + shift, theirs)
    truth = (1 + math.erf(shift / 2)) / 2  # of two normal scores whose means differ by ``shift``
    ends = {each: improvement_interval(each, n_seeds) for each in np.unique(found)}
    covered = np.mean([ends[each][0] < truth < ends[each][1] for each in found])
    assert 0.93 < covered < 0.98, covered


# Runs of each of three tasks, and what rliable 1.2.0 returns for their probability of improvement.
RLIABLE = [(4, 0.5208333333333334), (8, 0.515625), (12, 0.44675925925925924)]


@pytest.mark.parametrize(("n_seeds", "improvement"), RLIABLE)
def test_the_probability_of_improvement_is_that_of_rliable(n_seeds, improvement):
    ours, theirs = np.random.default_rng(n_seeds).normal(size=(2, n_seeds, 3))
    assert probability_of_improvement(ours.T, theirs.T).mean() == pytest.approx(
        improvement, abs=1e-12
    )


@pytest.mark.parametrize(
    ("n_nans", "ends"),
    [
        (0, (2, 97)),
        (1, (1, 98)),
        (10, (-np.inf, np.inf)),
    ],
)
def test_a_nan_counts_at_both_ends_of_an_interval(n_nans, ends):
    values = np.arange(100.0)
    values[40 : 40 + n_nans] = np.nan
    assert interval(values) == ends
