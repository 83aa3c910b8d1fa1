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
OWN = ("recorded frequencies", "recorded frequencies of pairs")
"""Laws are compared with these: the recorded frequency of each delay, and that given the delay
before it."""
Integers = NDArray[np.integer]
Floats = NDArray[np.floating]


class LawFit(NamedTuple):
    """A law (as settings write it, or one of ``OWN``) with its likeliest parameters for n messages.

    ``chances`` has the probabilities of the delays 0, 1, ..., K and, last, of a loss, whatever came
    before, [K + 2], ``likelihood`` is a logarithm [nats], and ``loss`` what ``delay.loss`` has to
    add to the law.
    """

    written: Any
    chances: Floats
    likelihood: float
    n_parameters: int
    n: int
    loss: float = 0.0

    @property
    def bic(self) -> float:
        """Bayesian information criterion: the less, the better."""
        return round(self.n_parameters * float(np.log(self.n)) - 2 * self.likelihood, 6)


def fit_laws(steps: Integers) -> tuple[LawFit, LawFit]:
    """The best of the laws that need nothing but delays, and the better of ``OWN``.

    Sequences [S, T] have the delays of messages in their order [steps], or marks; one at least has
    arrived.
    """
    codes = np.where(steps >= 0, steps, steps.max() - steps)  # K + 1 is lost, K + 2 none
    counts = np.bincount(codes.ravel(), minlength=int(steps.max()) + 3)[:-1]
    n = int(counts.sum())
    size = len(counts)
    chances = counts / counts.sum()
    pairs, often = np.unique(
        (codes[:, :-1] * size + codes[:, 1:])[codes[:, 1:] < size], return_counts=True
    )
    after = often / np.bincount(pairs // size, often, size)[pairs // size]
    starts = _likelihood(np.bincount(codes[:, 0], minlength=size), chances)
    own = LawFit(OWN[0], chances, _likelihood(counts, chances), int((counts > 0).sum()), n)
    paired = LawFit(OWN[1], chances, _likelihood(often, after) + starts, len(pairs), n)
    laws = [_memoryless(counts), *([_burst(codes, counts)] if (counts > 0).sum() > 1 else [])]
    return min(laws, key=attrgetter("bic")), min(own, paired, key=attrgetter("bic"))


def _likelihood(counts: NDArray[Any], chances: Floats) -> float:
    """Logarithm of the likelihood of counts of independent outcomes [nats]."""
    with np.errstate(divide="ignore"):
        return float(counts[counts > 0] @ np.log(chances[counts > 0]))


def _memoryless(counts: Integers) -> LawFit:
    """The best law without memory, for counts of the delays 0, 1, ..., K and, last, of losses
    [K + 2]."""
    n = int(counts.sum())
    arrived = int(counts[:-1].sum())
    delays = np.flatnonzero(counts[:-1]).tolist()
    loss = 1 - arrived / n
    low = min(delays, default=0)
    high = max(delays, default=0)
    fits = list[LawFit]()
    laws: list[tuple[Any, int]] = [(high, min(arrived, 1))]
    if low < high:
        mean = (
            counts[:-1] @ np.arange(len(counts) - 1) / (arrived - counts[high])
        )  # the longest are cut
        late = {
            "low": delays[low == 0],
            "high": high,
            "probability": round(1 - int(counts[0]) / arrived, 5),
        }
        laws = [({"law": "uniform", "low": low, "high": high}, 2), ({"law": "uniform", **late}, 3)]
        laws.append(({"law": "geometric", "mean": round(float(mean), 5), "longest": high}, 2))
    for law, k in laws:
        sampler = cast(TableSampler, sampler_of(law, loss=loss))
        chances = np.zeros(len(counts))
        table = sampler.chances[0].numpy()
        chances[: len(table) - 1], chances[-1] = table[:-1], table[-1]
        fits.append(
            LawFit(
                law, chances, _likelihood(counts, chances), k + (0 < loss < 1), n, round(loss, 5)
            )
        )
    return min(fits, key=attrgetter("bic"))


def _burst(codes: Integers, counts: Integers) -> LawFit:
    """Bursts whose messages tell the state of the channel: bad ones are lost, or later than the
    mean."""
    late = np.arange(len(counts)) > counts @ np.arange(len(counts)) / counts.sum()
    bad = np.append(late, True)[codes]
    pairs = (2 * bad[:, :-1] + bad[:, 1:])[codes[:, 1:] < len(counts)]
    moves = np.bincount(pairs, minlength=4).reshape(2, 2) + 0.5  # so that none is impossible
    (_, enter), (leave, _) = move = moves / moves.sum(1, keepdims=True)
    share = np.array([leave, enter]) / (enter + leave)
    path = _likelihood(moves, move) + _likelihood(np.bincount(bad[:, 0], minlength=2), share)
    good = _memoryless(counts * ~late)
    worse = _memoryless(counts * late)
    written = {"law": "burst", "enter": round(float(enter), 5), "leave": round(float(leave), 5)}
    written |= {"good": good.written, "bad": worse.written, "bad_loss": worse.loss}
    chances = share @ [good.chances, worse.chances]
    likelihood = good.likelihood + worse.likelihood + path
    return LawFit(
        written, chances, likelihood, 2 + good.n_parameters + worse.n_parameters, worse.n + good.n
    )
