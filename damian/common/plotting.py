"""Colours and style of all figures and films."""

import io
from pathlib import Path
from typing import TYPE_CHECKING

from damian.common.atomic_files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # slow to import

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colours that colour-blind readers can also tell apart (Okabe and Ito, 2008)."""
UAV_COLOURS = (*COLOURS, "#00446A", "#803800", "#005F45", "#7A4864", "#8A5F00", "#346C8C")
"""Colours of UAVs: after the usual ones the same darkened, in which texts are readable too."""
STYLE: dict = {"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}
"""Settings of Matplotlib."""


def save_figure(figure: "Figure", path: Path, dpi: int) -> None:
    """Write a figure as a picture of the kind that the path's suffix names."""
    picture = io.BytesIO()
    figure.savefig(picture, format=path.suffix[1:], dpi=dpi)
    write_atomically(path, picture.getvalue())
