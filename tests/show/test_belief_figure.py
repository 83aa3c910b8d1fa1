"""The figure of an episode: what its map shows."""

import numpy as np
import pytest
import shapely
import shapely.affinity
from episodes import SQUARE, flight
from matplotlib.figure import Figure

from damian.show.belief_figure import _draw_map


@pytest.mark.parametrize(("scale", "whole"), [(1.0, True), (2.0, True), (20.0, False)])
def test_the_map_shows_the_whole_region_unless_the_paths_are_small_in_it(scale, whole):
    region = shapely.affinity.scale(SQUARE, scale, scale)
    axis = Figure().subplots()
    _draw_map(axis, flight(region=region), 0)
    shown = shapely.box(*np.ravel([axis.get_xlim(), axis.get_ylim()], "F"))
    assert shown.covers(region) == whole
    assert shown.covers(shapely.box(-150, -170, 150, 150))  # the UAVs with their footprints, and the source
