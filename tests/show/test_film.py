"""Films of episodes: their frames, and who is told apart."""

import numpy as np
import pytest
from episodes import NO_SOURCE, UNKNOWN_SOURCE, crowd, flight
from matplotlib.colors import to_rgb, to_rgba
from PIL import Image

from damian.common.plotting import COLOURS
from damian.show.film import Film, save_film
from damian.show.frame import INK, LATENESS, frame_of


@pytest.mark.parametrize(
    ("changes", "title"),
    [
        ({}, "age of"),
        ({"battery": np.ones((4, 2)) * [[9], [8], [7], [6]]}, "battery"),
    ],
)
def test_a_film_has_a_frame_for_each_instant_that_differs(tmp_path, changes, title):
    save_film(flight(**changes), tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 4
        assert film.info["duration"] == 250
        film.seek(3)
        assert film.info["duration"] == 1500
    assert Film(flight(**changes)).charts[1].get_title("left").startswith(title)


@pytest.mark.parametrize(
    ("changes", "n_marks"),
    [
        ({}, 2),
        (NO_SOURCE, 0),
        (UNKNOWN_SOURCE, 0),
    ],
)
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


def shows(picture, colour):
    """Whether some pixel of a picture has a colour."""
    difference = np.abs(picture / 255 - to_rgb(colour)).max(-1)
    return bool((difference < 0.02).any())


@pytest.mark.parametrize(
    ("shown", "told"),
    [
        ((), []),
        (("17", "4"), ["4", "17"]),
    ],
)
def test_of_many_uavs_only_those_to_tell_apart_have_names_and_colours(shown, told):
    film = Film(crowd(), shown)
    assert [name.get_text() for name in named(film)] == told
    picture = film.frame(0)
    colours = [shows(picture, colour) for colour in COLOURS[:4]]
    assert colours == [number < len(told) for number in range(4)]


def colours_of_messages(film):
    """The colours of the messages, [R, T + 1, 4], without the grey of those that were not sent."""
    cells = film.lanes.collections[-1]
    return cells.to_rgba(cells.get_array())


@pytest.mark.parametrize("n_agents", [2, 40])
def test_messages_are_as_dark_as_they_are_late_and_black_if_they_are_lost(n_agents):
    delay = np.tile([[0], [2], [1], [-1]], n_agents)
    few = flight(**_copies(n_agents) | {"delay": delay, "sent": delay > -2})
    found = colours_of_messages(Film(few))
    expected = [to_rgba(each) for each in (LATENESS[0], LATENESS[2], LATENESS[1], INK)]
    np.testing.assert_allclose(found, np.tile([expected], (n_agents, 1, 1)), atol=0.01)


def _copies(n_agents):
    """Columns of so many UAVs, which all stand where the first of a flight does."""
    columns = "position target battery believed track age reward spotted sent delay"
    return {
        name: np.repeat(getattr(flight(), name)[:, :1], n_agents, axis=1)
        for name in columns.split()
    }


def test_rows_of_many_uavs_are_a_histogram_whose_latest_messages_are_on_top():
    delay = np.random.default_rng(0).integers(0, 9, (4, 40))
    film = Film(flight(**_copies(40) | {"delay": delay, "sent": delay >= 0}))
    np.testing.assert_array_equal(film.lanes.collections[-1].get_array(), 2 * np.sort(delay).T)
    assert film.lanes.get_ylabel() == "messages"


def test_covered_ground_is_drawn_and_fades():
    position = np.array([[[-100.0, 0, 0]], [[100.0, 0, 0]], [[100.0, 0, 0]], [[100.0, 0, 0]]])
    film = Film(flight(**_copies(1) | {"position": position}))

    def shade(step, east):
        film.draw(step)
        image = film.view.axis.images[0]
        west, end = image.get_extent()[:2]
        shades = image.get_array()
        return shades[len(shades) // 2, int((east - west) / (end - west) * shades.shape[1])]

    assert [shade(0, east) for east in (-100, 100)] == [1, 0]
    left, right = (shade(3, east) for east in (-100, 100))
    assert 0.25 < left < 0.8 < right == 1
    assert [shade(0, east) for east in (-100, 100)] == [1, 0]  # back at the reset


def test_uavs_have_their_colours_in_a_gif_too(tmp_path):
    rng = np.random.default_rng(0)
    places = rng.uniform(-180, 180, (20, 3)) * [1, 1, 0]
    cells = rng.uniform(-190, 190, (64, 2))
    belief = np.tile(10 ** rng.uniform(-4, -1, 64), (1, 1, 1))
    film = crowd(0, position=places[None], cells=cells, belief=belief)
    save_film(film, tmp_path / "film.gif", ["0", "1", "2"])
    with Image.open(tmp_path / "film.gif") as picture:
        shown = np.asarray(picture.convert("RGB"), int)
        drawn = Film(film, ["0", "1", "2"]).frame(0)
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
