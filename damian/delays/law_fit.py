"""Which delay law repeats recorded delays best: maximum likelihood, compared by BIC
(Schwarz, 1978)."""

from operator import attrgetter
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from damian.delays.laws import sampler_of
from damian.delays.samplers import TableSampler

LOST_STEPS, NO_MESSAGE = -1, -2
"""Marks among delays: a message that never arrives, and none, after the end of a sequence."""
Integers = NDArray[np.integer]
Floats = NDArray[np.floating]


class LawFit(NamedTuple):
    """A law, as settings write it, with its likeliest parameters for n messages.

    ``states`` has the probabilities of the states of the channel at a message and at the next one,
    [S, S], ``chances`` those of the delays 0, 1, ..., K and, last, of a loss, in each state,
    [S, K + 2]; ``likelihood`` is a logarithm [nats], and ``loss`` what ``delay.loss`` has to add to
    the law.
    """

    written: Any
    states: Floats
    chances: Floats
    likelihood: float
    n_parameters: int
    n: int
    loss: float = 0.0

    @property
    def bic(self) -> float:
        """Bayesian information criterion: the less, the better."""
        return round(self.n_parameters * float(np.log(self.n)) - 2 * self.likelihood, 6)


def fit_laws(steps: Integers) -> tuple[LawFit, float]:
    """Fit the laws that need nothing but delays; the best fit, and its distance to the recorded ones.

    Sequences [S, T] have the delays of messages in their order [steps], or marks; one at least has
    arrived. The distance is the total variation between the delays of two successive messages: the
    share of these pairs that the law gives other delays, from 0 to 1.
    """
    codes = np.where(steps >= 0, steps, steps.max() - steps)  # K + 1 is lost, K + 2 none
    none = int(steps.max()) + 2
    counts = np.bincount(codes.ravel(), minlength=none + 1)[:none]
    laws = [_memoryless(counts)]
    if np.count_nonzero(counts) > 1:
        laws.append(_burst(codes, counts))
    best = _best(laws)
    follows = codes[:, 1:] < none
    pairs = np.stack([codes[:, :-1][follows], codes[:, 1:][follows]])
    (delay, next_delay), often = np.unique(pairs, axis=1, return_counts=True)
    recorded = often / often.sum()
    chances = best.chances
    given = ((best.states.T @ chances[:, delay]) * chances[:, next_delay]).sum(0)
    return best, float((recorded - given).clip(0).sum())


def _best(fits: list[LawFit]) -> LawFit:
    return min(fits, key=attrgetter("bic"))


def _likelihood(counts: NDArray, chances: Floats) -> float:
    """Logarithm of the likelihood of counts of independent outcomes [nats]."""
    occurs = counts > 0
    with np.errstate(divide="ignore"):
        return float(counts[occurs] @ np.log(chances[occurs]))


def _memoryless(counts: Integers) -> LawFit:
    """The best law without memory, for counts of the delays 0, 1, ..., K and, last, of losses
    [K + 2]."""
    n = int(counts.sum())
    of_delays = counts[:-1]
    arrived = int(of_delays.sum())
    delays = np.flatnonzero(of_delays).tolist()
    loss = 1 - arrived / n
    low = min(delays, default=0)
    high = max(delays, default=0)
    fits = list[LawFit]()
    laws: list[tuple[Any, int]] = [(high, min(arrived, 1))]
    if low < high:
        uniform = {"law": "uniform", "low": low, "high": high}
        lowest_late = delays[low == 0]
        share_late = round(1 - int(counts[0]) / arrived, 5)
        often_late = uniform | {"low": lowest_late, "probability": share_late}
        sum_of_delays = of_delays @ np.arange(len(of_delays))
        mean = sum_of_delays / (arrived - counts[high])  # the longest are cut
        geometric = {"law": "geometric", "mean": round(float(mean), 5), "longest": high}
        laws = [(uniform, 2), (often_late, 3), (geometric, 2)]
    for law, k in laws:
        sampler = cast(TableSampler, sampler_of(law, loss=loss))
        *late, lost = sampler.chances[0].numpy()
        chances = np.zeros(len(counts))
        chances[: len(late)] = late
        chances[-1] = lost
        likelihood = _likelihood(counts, chances)
        n_parameters = k + (0 < loss < 1)
        one_state = np.ones((1, 1)), chances[None]
        fits.append(LawFit(law, *one_state, likelihood, n_parameters, n, round(loss, 5)))
    return _best(fits)


def _burst(codes: Integers, counts: Integers) -> LawFit:
    """Bursts whose messages tell the state of the channel: bad ones are lost, or later than the
    mean."""
    delays = np.arange(len(counts))
    late = delays > counts @ delays / counts.sum()
    bad = np.append(late, True)[codes]
    goes_on = codes[:, 1:] < len(counts)
    pairs = 2 * bad[:, :-1] + bad[:, 1:]
    n_moves = np.bincount(pairs[goes_on], minlength=4).reshape(2, 2)
    moves = n_moves + 0.5  # so that none is impossible
    move = moves / moves.sum(1, keepdims=True)
    (_, enter), (leave, _) = move
    share = np.array([leave, enter]) / (enter + leave)
    starts = np.bincount(bad[:, 0], minlength=2)
    path = _likelihood(moves, move) + _likelihood(starts, share)
    good = _memoryless(counts * ~late)
    worse = _memoryless(counts * late)
    written = {
        "law": "burst",
        "enter": round(float(enter), 5),
        "leave": round(float(leave), 5),
        "good": good.written,
        "bad": worse.written,
        "bad_loss": worse.loss,
    }
    states = share[:, None] * move
    chances = np.concatenate([good.chances, worse.chances])
    likelihood = good.likelihood + worse.likelihood + path
    n_parameters = 2 + good.n_parameters + worse.n_parameters
    return LawFit(written, states, chances, likelihood, n_parameters, worse.n + good.n)
