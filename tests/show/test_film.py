"""Films of episodes: their frames, and their views."""

import numpy as np
import pytest
from episodes import crowd, flight
from matplotlib.colors import to_rgb
from PIL import Image

from damian.common.plotting import COLOURS
from damian.show.film import Film, save_film
from damian.show.frame import frame_of


@pytest.mark.parametrize(
    ("changes", "title"), [({}, "age of"), ({"battery": np.ones((4, 2)) * [[9], [8], [7], [6]]}, "battery")]
)
def test_a_film_has_a_frame_for_each_instant_that_differs(tmp_path, changes, title):
    save_film(flight(**changes), tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 4
        assert film.info["duration"] == 250
        film.seek(3)
        assert film.info["duration"] == 1500
    assert Film(flight(**changes)).charts[1].get_title("left").startswith(title)


def test_a_film_of_the_space_shows_a_uav_above_the_place_where_it_stands():
    position = np.tile([[-100.0, 100.0, 0.0], [100.0, 100.0, 60.0]], (1, 1, 1))
    low, high = (Film(flight(0, position=position * [1, 1, scale]), "3d") for scale in (0.0, 1.0))
    same = np.abs(low.frame(0).astype(int) - high.frame(0)).sum(-1) == 0
    assert 0.5 < same.mean() < 0.999
    colours = [(np.abs(film.frame(0) / 255 - to_rgb(COLOURS[1])).max(-1) < 0.02) for film in (low, high)]
    heights = [np.nonzero(colour[:450, :500])[0].min() for colour in colours]
    assert heights[1] < heights[0] - 20


@pytest.mark.parametrize("view", ["2d", "3d"])
def test_each_of_many_uavs_and_rings_has_a_mark_and_a_name_beside_the_others(view):
    film = Film(crowd(age=np.ones((4, 20))), view)
    names = [artist for artist in film.draw(0) if hasattr(artist, "xyann")]
    texts = [*map(str, range(20)), *(f"{uav}, 1 s" for uav in range(20))]
    assert [name.get_text() for name in names] == texts
    assert len({tuple(np.round((*name.xy, *name.xyann), 2)) for name in names}) == 40
    assert len({(uav.colour, uav.edge) for uav in frame_of(film.episode, 0).uavs}) == 20
