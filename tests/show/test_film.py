"""Films of episodes: their frames, and who is told apart."""

import numpy as np
import pytest
from episodes import NO_SOURCE, UNKNOWN_SOURCE, crowd, flight
from matplotlib.colors import to_rgb
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


@pytest.mark.parametrize(("changes", "n_marks"), [({}, 2), (NO_SOURCE, 0), (UNKNOWN_SOURCE, 0)])
def test_a_film_tells_of_a_source_only_if_the_task_has_one(changes, n_marks):
    film = Film(flight(**changes))
    film.draw(0)
    assert ("0 of 2 UAVs spot the source" in film.figure.get_suptitle()) == (
        changes is not NO_SOURCE
    )
    labels = [text.get_text() for text in film.figure.legends[0].get_texts()]
    assert sum(label.startswith("source") for label in labels) == n_marks


def named(film):
    """The names on the map at the reset."""
    return [artist for artist in film.draw(0) if hasattr(artist, "xyann")]


def shows(film, colour):
    """Whether some pixel of a film has a colour."""
    return bool((np.abs(film.frame(0) / 255 - to_rgb(colour)).max(-1) < 0.02).any())


@pytest.mark.parametrize(("shown", "told"), [((), ["0", "1", "2"]), (("17", "4"), ["4", "17"])])
def test_of_many_uavs_only_those_to_tell_apart_have_names_colours_and_rows(shown, told):
    film = Film(crowd(), shown)
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


def test_charging_places_are_drawn_and_explained():
    places = flight(about={"charging_points": [[150.0, 150.0]]})
    plain, charged = (np.asarray(Film(e).frame(0), int)[100:500, :500] for e in (flight(), places))
    assert 20 < (np.abs(plain - charged).sum(-1) > 0).sum() < 200
    assert "charging place" in [
        text.get_text() for text in Film(places).figure.legends[0].get_texts()
    ]


def test_each_of_many_uavs_and_rings_has_a_mark_and_a_name_beside_the_others():
    film = Film(crowd(age=np.ones((4, 20))), [*map(str, range(20))])
    names = named(film)
    texts = [text for uav in range(20) for text in (f"{uav}", f"{uav}, 1 s")]
    assert [name.get_text() for name in names] == texts
    assert len({tuple(np.round((*name.xy, *name.xyann), 2)) for name in names}) == 40
    assert len({(uav.colour, uav.edge) for uav in frame_of(film.episode, 0).uavs}) == 20
