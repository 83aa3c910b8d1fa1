"""The figure of an episode: what its map shows."""

from dataclasses import replace

import numpy as np
from episodes import flight
from PIL import Image

from damian.show.belief_figure import plot_beliefs

UAV_COLUMNS = ("track", "battery", "spotted", "sent", "delay", "age", "reward")


def test_the_figure_is_written_for_more_uavs_than_there_are_colours(tmp_path):
    many = flight(2)
    wide = {
        name: np.repeat(getattr(many, name), 4, 1)
        for name in (*UAV_COLUMNS, "position", "target", "believed")
    }
    plot_beliefs(replace(many, **wide), tmp_path / "figure.png")
    with Image.open(tmp_path / "figure.png") as picture:
        assert picture.width == 1400
