"""The replay page in a real browser: it shows the numbers of the episode, and every part of it
draws.

Run by `make test-browser`.
"""

from contextlib import contextmanager
from functools import cache
from importlib import import_module

import numpy as np
import pytest
import shapely
from chromium import chromium, problems, resize
from episodes import NO_SOURCE, SQUARE, crowd, flight

from damian import compose_scenario, make_env
from damian.baselines.random import random_policy
from damian.envs.uav_env import EXTRAS
from damian.show.episode import record
from damian.show.frame import INK, LATENESS
from damian.show.replay_page import save_page

pytestmark = pytest.mark.browser
WEBGL = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
LAST = 20
LATE = 4
ROUND = 0.056
"""Largest error of a number of one decimal made of one with five significant digits, below
1,000."""


@cache
def late_flight():
    """Two UAVs that fly at random with a belief, whose messages are late, and some of which are
    lost."""
    words = (
        "scenario=mixed agents=2 motion=polynomial motion.max_acceleration=20 clock.simulation=2s"
    )
    words += (
        " delay.loss=0.1 source.level_db=150 battery.enabled=true "
        "observation.belief=[belief_moments]"
    )
    scenario = compose_scenario(*words.split(), f"delay.obs={LATE}")
    env = make_env(scenario, 1, 3, extras=EXTRAS)
    return record(env.rollout(LAST, random_policy(env)), env.uav_env, {"seed": 3})[0]


@pytest.fixture(scope="module")
def browser():
    """Chromium without a screen, whose WebGL is computed by the processor."""
    with chromium(*WEBGL) as driver:
        yield driver


class Page:
    """A page that is open, and what one can do with it."""

    def __init__(self, driver):
        self.driver = driver

    def run(self, code, *values):
        return self.driver.execute_script(code, *values)

    def all(self, selector):
        return self.driver.find_elements("css selector", selector)

    def one(self, selector):
        return self.driver.find_element("css selector", selector)

    def wait(self, condition, seconds=20):
        waits = import_module("selenium.webdriver.support.wait")
        waits.WebDriverWait(self.driver, seconds, 0.02).until(lambda _: condition())

    def settle(self):
        """Wait until what has changed is on the screen."""
        code = (
            "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(() => "
            "done()))"
        )
        self.driver.execute_async_script(code)

    def press(self, *keys):
        names = import_module("selenium.webdriver").Keys
        for key in keys:
            self.one("body").send_keys(getattr(names, key, key))
        self.settle()

    def actions(self):
        """What a mouse does."""
        return import_module("selenium.webdriver").ActionChains(self.driver)

    def time(self):
        return float(self.run("return document.querySelector('#transport input').value"))

    def shown(self, name):
        return self.one(f".card [data-shown={name}]").text

    def table(self):
        """The numbers of the UAVs at this instant, by column."""
        rows = self.all(".card .numbers tbody tr")
        names = ("east", "north", "up", "age", "battery")
        find = [
            [row.find_element("css selector", f"[data-shown={n}]") for n in names] for row in rows
        ]
        cells = np.array(
            [[float(cell.text.replace("\u2212", "-")) for cell in row] for row in find]
        )
        return dict(zip(names, cells.T, strict=True))

    def map(self):
        return self.run("return document.querySelector('canvas.map').toDataURL()")


@pytest.fixture
def opened(browser, tmp_path):
    """Open a page of episodes, and see that the browser has nothing to complain of."""

    @contextmanager
    def open_page(episode, keys=("HOME",)):
        save_page([episode], tmp_path / "page.html")
        resize(browser, 1280, 1600)
        browser.get((tmp_path / "page.html").as_uri())
        page = Page(browser)
        page.wait(lambda: page.run("return document.documentElement.dataset.ready"))
        page.settle()
        page.press(*keys)
        yield page
        assert problems(browser) == []

    return open_page


def check_numbers(page, episode, step):
    """The page shows the numbers of an instant of an episode."""
    table = page.table()
    for axis, name in enumerate(("east", "north", "up")):
        np.testing.assert_allclose(table[name], episode.position[step, :, axis], atol=ROUND)
    np.testing.assert_allclose(table["age"], episode.age[step], atol=ROUND)
    np.testing.assert_allclose(table["battery"], episode.battery[step], atol=ROUND)
    won = float(page.shown("return").split()[1])
    assert won == pytest.approx(episode.reward[: step + 1].mean(-1).sum(), abs=0.0051)
    assert page.shown("time") == f"{episode.time[step]:g} s"
    assert page.shown("spots").startswith(f"{episode.spotted[step].sum()} of 2")


def test_it_shows_the_numbers_of_every_instant_and_loads_nothing(opened):
    episode = late_flight()
    with opened(episode) as page:
        for step in range(LAST + 1):
            check_numbers(page, episode, step)
            page.press("ARROW_RIGHT")
        legend = [each.text for each in page.all("[data-chart=reward] .u-value")][1:]
        assert legend == [
            f"{term[LAST].mean():.3f}" for term in episode.reward_terms.values() if term.any()
        ]
        assert page.run("return performance.getEntriesByType('resource').length") == 0


def test_it_plays_pauses_and_ends_with_the_last_instant(opened):
    episode = late_flight()
    with opened(episode) as page:
        before = page.map()
        page.press(" ")
        page.wait(lambda: page.time() > 3)
        page.press(" ")
        paused = page.time()
        page.settle()
        assert page.time() == paused
        assert page.map() != before
        page.press(*["ARROW_UP"] * 5, " ")
        page.wait(lambda: page.time() == episode.time[-1])
        check_numbers(page, episode, LAST)
        assert page.shown("ended") == "ended"
        assert page.one("#transport .play").get_attribute("aria-label").startswith("play")
        page.press(*["ARROW_DOWN"] * 5, " ")
        page.wait(lambda: page.time() < episode.time[-1])


def test_the_slider_the_keys_and_a_click_in_a_chart_go_to_an_instant(opened):
    episode = late_flight()
    with opened(episode) as page:
        slide = "const s = document.querySelector('#transport input'); s.value = arguments[0];"
        slide += "s.dispatchEvent(new Event('input'))"
        for time, step in ((episode.time[-1], LAST), (13.2, 7)):
            page.run(slide, float(time))
            page.settle()
            check_numbers(page, episode, step)
        for key, step in (("END", LAST), ("ARROW_LEFT", LAST - 1), ("HOME", 0)):
            page.press(key)
            check_numbers(page, episode, step)
        for selector in ("[data-chart=age] .u-over", "canvas.lanes"):
            page.press("HOME")
            page.actions().move_to_element(page.one(selector)).click().perform()
            page.settle()
            step = round(page.time() / 2)
            assert 8 <= step <= 12
            check_numbers(page, episode, step)


def test_a_click_on_a_uav_or_on_its_number_dims_the_others(opened):
    with opened(flight(position=np.tile([[-100.0, 100, 0], [0, 0, 0]], (4, 1, 1)))) as page:
        dim = "return document.querySelector('.numbers tbody th').style.getPropertyValue('--uav')"
        before = page.run(dim)
        button = page.all(".numbers tbody button")[1]
        for press in (page.one("canvas.map").click, lambda: button.send_keys(" ")):
            press()
            page.settle()
            assert (button.get_attribute("aria-pressed"), page.run(dim) == before) == (
                "true",
                False,
            )
            page.press("ESCAPE")
            assert page.run(dim) == before


def test_of_many_uavs_the_list_chooses_the_one_that_is_told_apart(opened):
    with opened(crowd()) as page:
        before, (button, other) = (
            page.map(),
            (page.all(".numbers tbody button")[uav] for uav in (17, 3)),
        )
        choose = "const s = document.querySelector('#tools select'); s.value = arguments[0];"
        choose += "s.dispatchEvent(new Event('change'))"
        colour = "return arguments[0].parentElement.style.getPropertyValue('--uav')"
        assert page.run(colour, button) == page.run(colour, other)
        page.run(choose, "17")
        page.settle()
        assert page.shown("chosen").startswith("UAV 17: east 100.0 m, north 100.0 m, age 0.0 s")
        assert button.get_attribute("aria-pressed") == "true"
        assert page.run(colour, button) != page.run(colour, other)
        assert page.map() != before
        page.press("ESCAPE")
        assert page.run("return document.querySelector('#tools select').value") == ""
        assert (page.map(), page.all("[data-shown=chosen]")) == (before, [])


def test_a_page_tells_of_a_source_only_if_the_task_has_one(opened):
    for changes in (NO_SOURCE, {}):
        with opened(flight(**changes)) as page:
            assert len(page.all("p [data-shown=spots]")) == (changes is not NO_SOURCE)
            assert len(page.all("td[data-shown=spots]")) == 2 * (changes is not NO_SOURCE)


def test_zones_are_hatched_and_charging_places_marked(opened):
    colours = "const c = document.querySelector('canvas.map'); "
    colours += "const [w, h] = [c.width, c.height]; const n = Math.round(0.05 * Math.min(w, h));"
    colours += "const d = c.getContext('2d').getImageData((w - n) / 2, (h - n) / 2, n, n).data;"
    colours += "return new Set(new Uint32Array(d.buffer)).size"
    zone = SQUARE.difference(shapely.box(-60, -60, 60, 60))
    for changes in ({}, {"region": zone}, {"about": {"charging_points": [[0, 0]]}}):
        with opened(flight(source=None, emits=None, **changes)) as page:
            assert (page.run(colours) > 1) == bool(changes)


def test_a_drag_shows_a_part_of_the_time_which_follows_the_present(opened):
    with opened(late_flight()) as page:
        handles = (
            "return [...document.querySelectorAll('.brush input')].map((each) => "
            "Number(each.value))"
        )
        pictures = (
            "return ['.lanes', 'figure canvas'].map((c) => document.querySelector(c).toDataURL())"
        )
        for selector in ("[data-chart=age] .u-over", "canvas.lanes"):
            before = page.run(pictures)
            drag = (
                page.actions()
                .move_to_element_with_offset(page.one(selector), -60, 0)
                .click_and_hold()
            )
            drag.move_by_offset(120, 0).release().perform()
            page.settle()
            first, last = page.run(handles)
            assert 0 < first <= page.time() <= last < 2 * LAST
            assert not {*before} & {*page.run(pictures)}
            page.press("END")
            assert page.run(handles)[1] == pytest.approx(2 * LAST)
            page.press("a")


PIXELS = """
const c = document.querySelector(arguments[0]);
const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
const wanted = arguments[1].match(/[0-9a-f]{2}/g).map((each) => Number.parseInt(each, 16));
return new Uint32Array(d.buffer).reduce(
  (sum, _, i) => sum + wanted.every((value, k) => Math.abs(d[4 * i + k] - value) < 3), 0)
"""
"""Number of pixels of a canvas that have a colour."""


def test_rows_are_as_dark_as_messages_are_late_and_black_if_they_are_lost(opened):
    for n_agents, height in ((2, 20), (40, 110)):
        kinds = np.resize([[0, 0], [2, 2], [4, 4], [-1, -1]], (4, 2)).repeat(n_agents // 2, 1)
        few = "position target battery believed track age reward spotted"
        columns = {name: getattr(flight(), name).repeat(n_agents // 2, 1) for name in few.split()}
        episode = flight(delay=kinds, sent=kinds > -2, **columns)
        with opened(episode, ("END",)) as page:
            found = [page.run(PIXELS, "canvas.lanes", each) for each in (*LATENESS[1:], INK)]
            width = page.one("canvas.lanes").size["width"] / 3
            assert min(found) > 0.5 * width * height * (n_agents == 2 or 0.8)
            assert ("all UAVs" in page.one(".note").text) == (n_agents == 40)


def test_a_page_opens_where_the_server_is_most_mistaken_with_both_maps(opened):
    believed = np.tile([[-100.0, 100], [100, 100]], (4, 1, 1))
    believed[1:3, 0, 0] = [-60, -20]
    with opened(flight(believed=believed, age=np.ones((4, 2))), ()) as page:
        assert (page.shown("time"), page.shown("mistaken")) == ("4 s", "believed places 40 m off")
        maps = [page.one(f"canvas.{name}") for name in ("known", "map")]
        assert [each.is_displayed() for each in maps] == [True, True]
        assert maps[0].rect["x"] + maps[0].rect["width"] <= maps[1].rect["x"] + 1
        before = page.map()
        page.press("2")  # the believed ones are not on the map of what is true
        assert page.map() == before
        page.press("v")
        assert [each.is_displayed() for each in maps] == [False, True]
        page.press(" ")
        page.wait(lambda: page.time() < 4)  # it plays from the start


def test_a_belief_has_a_scale(opened):
    belief = {"cells": np.array([[-9.0, 0], [9, 0]]), "belief": np.full((4, 1, 2), 0.5)}
    with opened(flight(**belief)) as page:
        assert (page.shown("belief"), page.one(".scale").is_displayed()) == ("belief 1.0 bit", True)
