"""Figures of comparisons: colours that everybody can tell apart, and which methods have one."""

import itertools

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgb
from test_comparison import row

from damian.compare.comparison import Comparison
from damian.compare.config import Method
from damian.compare.figures import METHOD_COLOURS, _best
from damian.runs.run_folder import SCRIPT, TRAINED

TO_CONES = [[0.41222, 0.53633, 0.05145], [0.21190, 0.68070, 0.10740], [0.08830, 0.28172, 0.62998]]
TO_LAB = [[0.21045, 0.79362, -0.00407], [1.97800, -2.42859, 0.45059], [0.02590, 0.78277, -0.80868]]
"""Björn Ottosson (2020), "A perceptual color space for image processing" (OKLab)."""
DEUTERANOPIA = [
    [0.36732, 0.86065, -0.22797],
    [0.28009, 0.67250, 0.04741],
    [-0.01182, 0.04294, 0.96888],
]
"""What is seen without green receptors, in linear RGB (Machado, Oliveira and Fernandes 2009)."""


def oklab(colour, seen):
    srgb = np.array(to_rgb(colour))
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return np.array(TO_LAB) @ np.cbrt(np.array(TO_CONES) @ (seen @ linear).clip(0, 1))


@pytest.mark.parametrize(
    "seen", [np.eye(3), np.array(DEUTERANOPIA)], ids=["all receptors", "deuteranopia"]
)
def test_colours_of_methods_are_far_apart(seen):
    places = [oklab(colour, seen) for colour in METHOD_COLOURS]
    pairs = itertools.combinations(places, 2)
    assert min(np.linalg.norm(a - b) for a, b in pairs) > 0.15  # 1: black to white
    assert all(place[0] < 0.85 for place in places)  # they are seen on white


@pytest.mark.parametrize(("score", "best"), [("return", range(2, 8)), ("steps", range(6))])
def test_the_six_best_methods_are_coloured(score, best):
    methods = {
        f"{i}": Method(naive=True, delayed=i > 0, flies=SCRIPT if i == 7 else None)
        for i in range(8)
    }
    rows = [
        row("task", "4" if i else "none", f"{i}", seed, float(i), SCRIPT if i == 7 else TRAINED)
        for i in range(8)
        for seed in (8, 9)
    ]
    found = Comparison(pd.DataFrame(rows), pd.DataFrame(), methods, score)
    assert _best(found) == {f"{i}" for i in best}
