"""The figure of an episode: what its map shows."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
import shapely.affinity
from episodes import SQUARE, flight
from matplotlib.figure import Figure
from PIL import Image

from damian.show.belief_figure import draw_map, plot_beliefs

UAV_COLUMNS = ("track", "battery", "spotted", "sent", "delay", "age", "reward")


@pytest.mark.parametrize(("scale", "whole"), [(1.0, True), (2.0, True), (20.0, False)])
def test_the_map_shows_the_whole_region_unless_the_paths_are_small_in_it(scale, whole):
    region = shapely.affinity.scale(SQUARE, scale, scale)
    axis = Figure().subplots()
    draw_map(axis, flight(region=region), 0)
    shown = shapely.box(*np.ravel([axis.get_xlim(), axis.get_ylim()], "F"))
    assert shown.covers(region) == whole
    assert shown.covers(shapely.box(-150, -170, 150, 150))  # the UAVs with their footprints, and the source


def test_the_figure_is_written_for_more_uavs_than_there_are_colours(tmp_path):
    many = flight(2)
    wide = {
        name: np.repeat(getattr(many, name), 4, 1)
        for name in (*UAV_COLUMNS, "position", "target", "believed")
    }
    plot_beliefs(replace(many, **wide), tmp_path / "figure.png")
    with Image.open(tmp_path / "figure.png") as picture:
        assert picture.width == 1400
