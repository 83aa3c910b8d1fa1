"""Colours and style of all figures and films."""

from typing import Any

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colours that colour-blind readers can also tell apart (Okabe and Ito, 2008)."""
UAV_COLOURS = (*COLOURS, "#00446A", "#803800", "#005F45", "#7A4864", "#8A5F00", "#346C8C")
"""Colours of UAVs: after the usual ones the same darkened, in which texts are readable too."""
STYLE: dict[Any, Any] = {"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}
"""Settings of Matplotlib."""
