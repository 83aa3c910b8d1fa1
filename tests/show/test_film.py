"""Films of episodes: their frames, and their views."""

import numpy as np
import pytest
from episodes import NO_SOURCE, UNKNOWN_SOURCE, crowd, flight
from matplotlib.colors import to_rgb
from mpl_toolkits.mplot3d.proj3d import proj_transform
from PIL import Image

from damian.common.plotting import COLOURS
from damian.show.film import Film, save_film
from damian.show.frame import frame_of


@pytest.mark.parametrize(
    ("changes", "title"),
    [({}, "age of"), ({"battery": np.ones((4, 2)) * [[9], [8], [7], [6]]}, "battery")],
)
def test_a_film_has_a_frame_for_each_instant_that_differs(tmp_path, changes, title):
    save_film(flight(**changes), tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 4
        assert film.info["duration"] == 250
        film.seek(3)
        assert film.info["duration"] == 1500
    assert Film(flight(**changes)).charts[1].get_title("left").startswith(title)


@pytest.mark.parametrize("view", ["2d", "3d"])
@pytest.mark.parametrize(("changes", "n_marks"), [({}, 2), (NO_SOURCE, 0), (UNKNOWN_SOURCE, 0)])
def test_a_film_tells_of_a_source_only_if_the_task_has_one(view, changes, n_marks):
    film = Film(flight(**changes), view)
    film.draw(0)
    assert ("0 of 2 UAVs spot the source" in film.figure.get_suptitle()) == (
        changes is not NO_SOURCE
    )
    labels = [text.get_text() for text in film.figure.legends[0].get_texts()]
    assert sum(label.startswith("source") for label in labels) == n_marks


def test_a_film_of_the_space_shows_a_uav_above_the_place_where_it_stands():
    position = np.tile([[-100.0, 100.0, 0.0], [100.0, 100.0, 60.0]], (1, 1, 1))
    low, high = (Film(flight(0, position=position * [1, 1, scale]), "3d") for scale in (0.0, 1.0))
    same = np.abs(low.frame(0).astype(int) - high.frame(0)).sum(-1) == 0
    assert 0.5 < same.mean() < 0.999
    colours = [
        (np.abs(film.frame(0) / 255 - to_rgb(COLOURS[1])).max(-1) < 0.02) for film in (low, high)
    ]
    heights = [np.nonzero(colour[:450, :500])[0].min() for colour in colours]
    assert heights[1] < heights[0] - 20


def named(film):
    """The names on the map at the reset."""
    return [artist for artist in film.draw(0) if hasattr(artist, "xyann")]


def shows(film, colour):
    """Whether some pixel of a film has a colour."""
    return bool((np.abs(film.frame(0) / 255 - to_rgb(colour)).max(-1) < 0.02).any())


@pytest.mark.parametrize("view", ["2d", "3d"])
@pytest.mark.parametrize(("shown", "told"), [((), ["0", "1", "2"]), (("17", "4"), ["4", "17"])])
def test_of_many_uavs_only_those_to_tell_apart_have_names_colours_and_rows(view, shown, told):
    film = Film(crowd(), view, shown)
    assert [name.get_text() for name in named(film)] == told
    assert [label.get_text() for label in film.lanes.get_yticklabels()] == [
        f"UAV {name}" for name in told
    ]
    colours = [shows(film, colour) for colour in COLOURS[:4]]
    assert colours == [number < len(told) for number in range(4)]
    labels = [text.get_text() for text in film.figure.legends[0].get_texts()]
    assert f"{20 - len(told)} other UAVs" in labels


def test_uavs_have_their_colours_in_a_gif_too(tmp_path):
    rng = np.random.default_rng(0)
    places = rng.uniform(-180, 180, (20, 3)) * [1, 1, 0]
    cells = rng.uniform(-190, 190, (64, 2))
    belief = np.tile(10 ** rng.uniform(-4, -1, 64), (1, 1, 1))
    film = crowd(0, position=places[None], cells=cells, belief=belief)
    save_film(film, tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as picture:
        shown = np.asarray(picture.convert("RGB"), int)
        drawn = Film(film).frame(0)
    for colour in COLOURS[:3]:
        found = (drawn == np.round(np.multiply(to_rgb(colour), 255))).all(-1)
        assert found.any()
        assert np.abs(shown - drawn)[found].max() < 12


@pytest.mark.parametrize(
    ("up", "said"),
    [(0.0, "450 m"), (60.0, "heights 2 times as large"), (900.0, "heights to scale")],
)
def test_a_film_of_the_space_cuts_nothing_and_says_how_heights_are_drawn(up, said):
    position = np.tile([[-200.0, -200, up], [200, 200, up]], (301, 1, 1))
    film = Film(flight(300, position=position), "3d")
    assert film.figure.texts[0].get_text().endswith(said)
    corners = [[x, y, z] for x in (-200, 200) for y in (-200, 200) for z in (0, up)]
    for step in (0, 60, 150, 300):
        film.draw(step)
        seen = np.transpose(proj_transform(*np.transpose(corners), film.map.get_proj())[:2])
        x, y = film.map.transData.transform(seen).T
        assert 0 < x.min() < x.max() < film.charts[0].bbox.x0 - 15
        assert film.lanes.bbox.y1 < y.min() < y.max() < film.figure.bbox.y1 - 35
        inside = film.map.bbox
        assert (
            (inside.x0, inside.y0)
            < (x.min(), y.min())
            < (x.max(), y.max())
            < (inside.x1, inside.y1)
        )


@pytest.mark.parametrize("view", ["2d", "3d"])
def test_charging_places_are_drawn_and_explained(view):
    places = flight(about={"charging_points": [[150.0, 150.0]]})
    plain, charged = (
        np.asarray(Film(e, view).frame(0), int)[100:500, :500] for e in (flight(), places)
    )
    assert 20 < (np.abs(plain - charged).sum(-1) > 0).sum() < 200
    assert "charging place" in [
        text.get_text() for text in Film(places).figure.legends[0].get_texts()
    ]


@pytest.mark.parametrize("view", ["2d", "3d"])
def test_each_of_many_uavs_and_rings_has_a_mark_and_a_name_beside_the_others(view):
    film = Film(crowd(age=np.ones((4, 20))), view, [*map(str, range(20))])
    names = named(film)
    texts = [*map(str, range(20)), *(f"{uav}, 1 s" for uav in range(20))]
    assert [name.get_text() for name in names] == texts
    assert len({tuple(np.round((*name.xy, *name.xyann), 2)) for name in names}) == 40
    assert len({(uav.colour, uav.edge) for uav in frame_of(film.episode, 0).uavs}) == 20
