"""Frequencies of recorded delays."""

import random

import pytest

from damian.delays.samplers import Recorded


class Watched(int):
    """A number that counts how often numbers are compared."""

    comparisons = 0

    def _compared(self, name, other):
        Watched.comparisons += 1
        return getattr(int, name)(self, other)

    def __eq__(self, other):
        return self._compared("__eq__", other)

    def __lt__(self, other):
        return self._compared("__lt__", other)

    def __gt__(self, other):
        return self._compared("__gt__", other)

    __hash__ = int.__hash__


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("loss", [0.0, 0.25])
def test_the_probabilities_are_the_shares_of_the_recorded_delays(seed, loss):
    draw = random.Random(seed)
    delays = [draw.choice([-1, 0, 0, 2, 3, 9]) for _ in range(draw.randrange(1, 50))]
    chances = Recorded(delays, loss).chances[0].tolist()
    longest = max(*delays, 0)
    assert chances[:-1] == [delays.count(k) / len(delays) * (1 - loss) for k in range(longest + 1)]
    assert chances[-1] == pytest.approx(1 - sum(chances[:-1]))


def test_a_long_record_is_read_a_few_times_however_many_delays_it_has():
    delays = [Watched(k % 200) for k in range(2000)]
    Watched.comparisons = 0
    Recorded(delays, 0.0)
    assert Watched.comparisons < 10 * len(delays)
