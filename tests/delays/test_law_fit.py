"""Laws and their parameters are found again in the delays that were drawn from them."""

from itertools import product

import delay_twin
import numpy as np
import pytest
import torch

from damian.common import counter_rng
from damian.delays.law_fit import LOST_STEPS, NO_MESSAGE, fit_laws
from damian.delays.laws import sampler_of

UNIFORM = {"law": "uniform", "low": 3, "high": 7}
BURST = {
    "law": "burst",
    "enter": 0.05,
    "leave": 0.2,
    "good": 1,
    "bad": UNIFORM,
    "bad_loss": 0.3,
}
LAWS = [
    3,
    UNIFORM,
    {**UNIFORM, "probability": 0.15},
    {"law": "geometric", "mean": 2.5, "longest": 6},
]
LOSSES = {**BURST, "good": 0, "bad": 0, "bad_loss": 1.0}


def drawn(law, loss=0.0, seed=0):
    """Delays [steps] of the messages of 30 senders: 15 send 200 messages each, the others 150."""
    sampler = sampler_of(law, loss=loss)
    delays = delay_twin.drawn(sampler, counter_rng.world_seeds(seed, 30), 200).T
    found = torch.where(delays < sampler.lost, delays, LOST_STEPS).numpy()
    found[::2, 150:] = NO_MESSAGE
    return found


def check_alike(found, law):
    """Check that settings are the same, probabilities and means about."""
    if isinstance(law, dict):
        assert found.keys() == law.keys()
        for name in law:
            check_alike(found[name], law[name])
    else:
        assert found == (pytest.approx(law, rel=0.15) if isinstance(law, float) else law)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("law", "loss"), [*product(LAWS, (0.0, 0.1)), (BURST, 0.0), (LOSSES, 0.0)], ids=str
)
def test_a_law_is_found_again(law, loss, seed):
    best, distance = fit_laws(drawn(law, loss, seed))
    check_alike(best.written, law)
    assert best.loss == pytest.approx(loss, rel=0.15)
    assert distance < 0.05


def test_delays_that_no_law_repeats_are_far_from_all_laws():
    twice = np.random.default_rng(0).choice([1, 2, 7, 8], (20, 100), p=[0.5, 0.1, 0.1, 0.3])
    held = drawn({"law": "lag", "lag": UNIFORM, "hold_probability": 0.8})
    for steps in (held, twice):
        best, distance = fit_laws(steps)
        longer = np.pad(steps, ((0, 0), (0, 9)), constant_values=NO_MESSAGE)
        best_longer, distance_longer = fit_laws(longer)
        assert (best_longer.written, distance_longer) == (best.written, distance)
        assert distance > 0.2
