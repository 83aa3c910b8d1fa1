"""Figures of comparisons: colours that everybody can tell apart."""

import itertools

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from damian.compare.figures import METHOD_COLOURS

TO_CONES = [[0.41222, 0.53633, 0.05145], [0.21190, 0.68070, 0.10740], [0.08830, 0.28172, 0.62998]]
TO_LAB = [[0.21045, 0.79362, -0.00407], [1.97800, -2.42859, 0.45059], [0.02590, 0.78277, -0.80868]]
"""Björn Ottosson (2020), "A perceptual color space for image processing" (OKLab)."""
DEUTERANOPIA = [[0.36732, 0.86065, -0.22797], [0.28009, 0.67250, 0.04741], [-0.01182, 0.04294, 0.96888]]
"""What is seen without green receptors, in linear RGB (Machado, Oliveira and Fernandes 2009)."""


def oklab(colour: str, seen: np.ndarray) -> np.ndarray:
    srgb = np.array(to_rgb(colour))
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return np.array(TO_LAB) @ np.cbrt(np.array(TO_CONES) @ (seen @ linear).clip(0, 1))


@pytest.mark.parametrize("seen", [np.eye(3), np.array(DEUTERANOPIA)], ids=["all receptors", "deuteranopia"])
def test_colours_of_methods_are_far_apart(seen):
    places = [oklab(colour, seen) for colour in METHOD_COLOURS]
    assert (
        min(np.linalg.norm(a - b) for a, b in itertools.combinations(places, 2)) > 0.15
    )  # 1: black to white
    assert all(place[0] < 0.85 for place in places)  # they are seen on white
