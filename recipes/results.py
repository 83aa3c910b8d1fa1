"""One table of the results in a folder: of a run, of a sweep, or of a comparison (docs/runs.md).

damian results runs/FOLDER
damian results runs/A runs/B    # and the differences of B to A, paired by seed
damian.results("runs/FOLDER")   # in Python
"""

from pathlib import Path

import pandas as pd
from omegaconf import DictConfig

from damian.common.tables import markdown_table
from damian.runs.run_folder import RESULTS

from . import cli
from .shared.sweeps import MARKDOWN, POINTS, compared, report, stored_results, sweep_rows


def results(folder: str | Path) -> pd.DataFrame:
    """The results in a folder, a row for each policy of each run.

    A comparison has the columns task, delay, method, regime and seed, a sweep one for each setting
    in which its runs differ. ``return`` and other measures are true values, those that begin with
    ``perceived_`` what the server knew.

    Raises:
        InputError: there is no result in the folder.
    """
    folder = Path(folder)
    return stored_results(folder).rows if (folder / POINTS).is_file() else sweep_rows(folder)[1]


def table(folders: list[Path], score: str) -> str:
    """The table of a folder, or of two folders."""
    folder = folders[0]
    is_comparison = (folders[0] / POINTS).is_file()
    if len(folders) == 2:
        return compared(folders, score)
    if is_comparison and (folder / MARKDOWN).exists():
        return (folder / MARKDOWN).read_text(encoding="utf-8")
    if is_comparison or (folder / RESULTS).exists():
        rows = results(folder)
        cells = rows.map(lambda x: f"{x:.4g}" if isinstance(x, float) else str(x))
        return markdown_table([*map(str, rows)], cells.to_numpy())
    return f"{report(folder)}\n\nresults: {folder}"


@cli.program("results")
def main(given: DictConfig) -> None:
    config = cli.checked(given, [], "results")
    print(table([*map(Path, config.folders)], config.score))
