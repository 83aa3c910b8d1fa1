"""Figures of comparisons and sweeps: colours that everybody can tell apart, and what stands
where."""

import itertools

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from test_comparison import row

from damian.compare.comparison import Comparison
from damian.compare.config import Method
from damian.compare.figures import METHOD_COLOURS, _best, plot_sweep
from damian.compare.paired import means
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


MEASURES = ["return", "success_rate", "steps", "perceived_return", "age"]


def test_a_sweep_has_a_curve_for_each_value_of_the_settings_that_are_not_along_the_axis(
    tmp_path, monkeypatch
):
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    returns = {
        ("none", 4): 2.0,
        ("none", 0): 9.0,
        ("timeline", 4): 7.0,
    }
    rows = pd.DataFrame(
        [
            (*place, policy, seed, 9, mean + seed - 10 * (policy == "script"), 0.0, 1.0, 0.0, 0.0)
            for place, mean in returns.items()
            for seed in (-1, 0, 1)
            for policy in ("trained", "script", "untrained")
        ],
        columns=[*(groups := ["aware", "delay.obs"]), "policy", "seed", "episodes", *MEASURES],
    )
    for keys in (groups, groups[:1], []):
        plot_sweep(means(rows, keys), keys, tmp_path / "figure.png")
    assert len(drawn) == 2  # without a setting there is nothing to draw
    axis = drawn[0].axes[0]
    assert axis.get_xlabel() == "delay.obs"
    found = {each.get_label(): each[0].get_xydata().tolist() for each in axis.containers}
    assert found == {
        "none trained": [[0, 9], [4, 2]],
        "none script": [[0, -1], [4, -8]],
        "timeline trained": [[4, 7]],
        "timeline script": [[4, -3]],
    }
    low, high = axis.containers[0][2][0].get_segments()[1][:, 1]
    assert low < 2 < high
    assert [label.get_text() for label in drawn[1].axes[0].get_xticklabels()] == [
        "none",
        "timeline",
    ]


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
