"""What a dynamic source does after its walk: it begins it anew, for any number of rounds."""

from fractions import Fraction

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from walks import dynamic_walks, n_stops, twin_position

from damian.world.signal_source import Walk, locate

LOOP = {"after_walk": "loop"}


@given(
    seed=st.integers(0, 10**6),
    steps=st.integers(0, 10**9),
    dt=st.sampled_from([0.1, 1.0, 3.0, 60.0, 1 / 3]),
    n_hotspots=st.integers(1, 3),
)
def test_after_any_number_of_rounds_the_source_is_where_exact_arithmetic_says(seed, steps, dt, n_hotspots):
    walk = dynamic_walks(
        n=1, seed=seed, n_hotspots=n_hotspots, min_stops=1, max_stops=2, min_wait=0.5, max_wait=5.0, **LOOP
    )
    located = locate(walk, torch.tensor([steps], dtype=torch.float64) * dt, loops=True)
    time = Fraction(steps * dt)  # as a float64 has it
    end = Fraction(walk.depart[0, -1].item())
    tour, place, stop = int(time // end), *twin_position(returning(walk), 0, float(time % end))
    assert located.tour.item() == tour
    assert located.stop.item() == stop
    assert located.position[0].tolist() == pytest.approx(place, abs=2e-2)
    assert not located.finished.any()


def returning(walk):
    """A walk for the twin, which reaches its first stop a second time."""
    n = int(n_stops(walk)[0])
    arrive = torch.cat([walk.arrive[:, :n], walk.depart[:, n : n + 1]], 1)
    return Walk(*(field[:, : n + 1] for field in walk))._replace(arrive=arrive)
