"""Prints whether delaybench_mini orders the methods as delaybench does: Spearman's rank
correlation.

python docs/rank_correlation.py [FOLDER]     (of the mini's rows; otherwise those that are stored)

The interval (95 %) is of a bootstrap over the seeds of each method, in both. Last come correlations
of training returns after fewer steps of delaybench itself, of the methods whose curves are stored.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import spearmanr

RESULTS = Path(__file__).parent / "results"
LAW, DRAWS = "1-7", 10_000


def returns(rows: pd.DataFrame, task: str, column: str = "return") -> dict[str, np.ndarray]:
    """Returns of the seeds of each method, under one to seven steps."""
    rows = rows[(rows["task"] == task) & (rows["delay"] == LAW)]
    return {str(name): group[column].to_numpy() for name, group in rows.groupby("method")}


def correlation(small: dict[str, np.ndarray], large: dict[str, np.ndarray]) -> str:
    """Spearman's correlation of the methods' means, with its interval."""
    methods, rng = [name for name in small if name in large], np.random.default_rng(0)

    def means(seeds: dict[str, np.ndarray], again: bool) -> list[float]:
        return [
            np.mean(rng.choice(seeds[m], len(seeds[m])) if again else seeds[m]) for m in methods
        ]

    value = spearmanr(means(small, False), means(large, False))[0]
    drawn = [spearmanr(means(small, True), means(large, True))[0] for _ in range(DRAWS)]
    low, high = np.percentile(drawn, [2.5, 97.5])
    return f"{value:.2f} [{low:.2f}, {high:.2f}] of {len(methods)} methods"


def main(folder: Path) -> None:
    """Print the returns and the correlations."""
    trained = [
        pd.read_csv(each / "results.csv").query("policy == 'trained'")
        for each in (folder, RESULTS / "delaybench")
    ]
    small, large = returns(trained[0], "crowded_mini"), returns(trained[1], "crowded")
    for name in sorted(small, key=lambda name: -large[name].mean()):
        cells = (f"{seeds[name].mean():5.1f} ({len(seeds[name])})" for seeds in (small, large))
        print(f"{name:20}", *cells)
    print(f"mini and delaybench: {correlation(small, large)}")
    print(f"delaybench and itself, on other seeds: {correlation(large, large)}")
    curves = pd.read_csv(RESULTS / "delaybench" / "curves.csv")
    for steps in (200_000, 300_000, 400_000, 500_000, 700_000):
        part = curves[curves["frames"].between(0.9 * steps, steps)]
        part = part.groupby(["task", "delay", "method", "seed"], as_index=False)[
            "hindsight_return"
        ].mean()
        print(
            f"after {steps:,} steps: "
            f"{correlation(returns(part, 'crowded', 'hindsight_return'), large)}"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else RESULTS / "delaybench_mini")
