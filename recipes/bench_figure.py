"""The figure of ``damian bench``: how many times as fast as VMAS each environment is."""

from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

LABELS = ("in rollouts, random actions", "in a collector, with a policy")


def plot_ratios(ratios: Mapping[str, tuple[float, float]], path: Path) -> None:
    """Draw a pair of bars for each environment.

    Args:
        ratios: environment steps per second over those of VMAS, in rollouts and in a collector, by name.
        path: image file.
    """
    figure = Figure(figsize=(8, 0.45 * len(ratios) + 1), layout="constrained")
    axis = figure.subplots()
    for shift, label, column in zip((0.2, -0.2), LABELS, zip(*ratios.values(), strict=True), strict=True):
        rows = [row + shift for row in range(len(ratios))]
        bars = axis.barh(rows, column, height=0.38, label=label)
        axis.bar_label(bars, fmt="%.1f", padding=3)
    axis.set_yticks(range(len(ratios)), list(ratios))
    axis.invert_yaxis()
    axis.axvline(1, color="0.4", linewidth=0.8)
    axis.set(xlabel="times as fast as VMAS discovery")
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(loc="lower right", frameon=False)
    figure.savefig(path, dpi=150)
