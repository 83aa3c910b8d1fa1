"""Films of episodes: the pixels of a frame mean what they should."""

import numpy as np
import pytest
from episodes import flight
from matplotlib.colors import to_rgb
from PIL import Image

from damian.common.plotting import COLOURS
from damian.show.film import Film, save_film


def colour_at(film: Film, step: int, east: float, north: float) -> np.ndarray:
    """The colour of a place on the map, in [0, 1]."""
    picture = film.frame(step)
    column, row = film.map.transData.transform((east, north))
    return picture[round(len(picture) - 1 - row), round(column)] / 255


def test_a_uav_has_its_colour_where_it_truly_is_and_turns_with_its_heading():
    film = Film(flight(track=np.array([[0.0, 0.0], [0.0, np.pi / 2], [0.0, np.pi], [0.0, 0.0]])))
    for uav, east in enumerate((-100.0, 100.0)):
        np.testing.assert_allclose(colour_at(film, 0, east, 102.0), to_rgb(COLOURS[uav]), atol=0.02)
    to_north, to_east = (np.abs(colour_at(film, t, 105.0, 100.0) - to_rgb(COLOURS[1])).sum() for t in (0, 1))
    assert to_east < 0.8 * to_north


def test_a_ring_stands_where_the_server_believes_a_uav_only_if_it_is_mistaken_in_time():
    believed = np.tile([[-100.0, 100.0], [-100.0, -150.0]], (2, 1, 1))
    film = Film(flight(1, believed=believed, age=np.array([[0.0, 0.0], [0.0, 4.0]])))
    radius = 12 / 2 / 72 * film.figure.dpi
    scale = film.map.transData.transform([(0, 0), (1, 0)])
    east = -100.0 + radius / (scale[1, 0] - scale[0, 0])
    assert np.abs(colour_at(film, 0, east, -150.0) - colour_at(film, 0, 150.0, -150.0)).max() < 0.02
    np.testing.assert_allclose(colour_at(film, 1, east, -150.0), to_rgb(COLOURS[1]), atol=0.1)
    assert [text.get_text() for text in film.map.texts] == ["4 s"]


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
