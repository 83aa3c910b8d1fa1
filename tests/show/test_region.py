"""The picture of a region that was read, and what is said of it."""

import pytest
from PIL import Image

from damian import UavEnv, compose_scenario
from damian.show.region import save_region

SQUARE = "region.vertices=[[0,0],[1000,0],[1000,500],[0,500]]"


@pytest.mark.parametrize(
    ("level_db", "fits"),
    [
        (115, False),
        (135, True),
        (155, False),
    ],
)
def test_it_draws_the_region_and_warns_where_footprints_do_not_fit(tmp_path, level_db, fits):
    words = ("scenario=coverage", "region=vertices", SQUARE, f"source.level_db={level_db}")
    told = save_region(UavEnv(compose_scenario(*words), 1).simulation, tmp_path / "region.png")
    assert "0.5 km²" in told
    assert ("warning" in told) != fits
    with Image.open(tmp_path / "region.png") as picture:
        colours = {colour for _, colour in picture.convert("RGB").getcolors(1 << 20)}
    assert (245, 242, 234) in colours  # the land
    assert len(colours) > 50
