"""The map of a fleet in a real browser, on a service that runs: `make test-browser`."""

import threading
import time
from contextlib import contextmanager
from importlib import import_module

import pytest
import uvicorn
from chromium import chromium, problems, resize
from reports import read_json

from damian_fleet.fleet import Fleet
from damian_fleet.program import config_of, make_fleets
from damian_fleet.rows import Asking
from damian_fleet.service import make_app

pytestmark = pytest.mark.browser
TOKEN = "map-map-map-map-map"
PLACES = {"A": (52.8110, -4.1283), "B": (52.8124, -4.1274)}
COLOURS = """
const { width, height } = document.getElementById('map');
const data = document.getElementById('map').getContext('2d').getImageData(0, 0, width, height).data;
const seen = {};
for (let i = 0; i < data.length; i += 4) {
  const key = [...data.slice(i, i + 3)].join();
  seen[key] = (seen[key] ?? 0) + 1;
}
return seen;
"""


@contextmanager
def service():
    """The fleets of a service that runs, and its address."""
    words = ["region=llanbedr", "motion=polynomial", "database=':memory:'"]
    fleets = make_fleets(*config_of(words))
    server = uvicorn.Server(uvicorn.Config(make_app(fleets, TOKEN), port=0, log_level="warning"))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.02)
    yield fleets, f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join()


def report(fleets, uav, number):
    lat, lon = PLACES[uav]
    row = {
        "ID": uav,
        "number": number,
        "time": time.time(),
        "lat": lat,
        "lon": lon,
        "battery": 80 - number,
    }
    fleets.take("north", Fleet.reported, read_json(row), time.time())


def test_the_map_shows_each_uav_its_goal_and_its_row_and_asks_for_the_token(tmp_path):
    with service() as (fleets, address), chromium() as driver:
        wait = (
            import_module("selenium.webdriver.support.wait").WebDriverWait(driver, 20, 0.05).until
        )
        text = lambda name: driver.find_element("id", name).text  # noqa: E731
        resize(driver, 1000)
        fleets.create("north", [*PLACES])
        for uav in PLACES:
            report(fleets, uav, 1)
        fleets.take("north", Fleet.advised, Asking(uavs=["A"]), time.time())
        driver.get(f"{address}/fleets/north/map")
        field = driver.find_element("id", "token")
        field.send_keys("wrong\n")
        wait(lambda _: "token" in text("shared") and "wrong" in text("shared"))
        field.clear()
        field.send_keys(TOKEN + "\n")
        wait(lambda _: len(driver.find_elements("css selector", "#uavs tr")) == len(PLACES))
        assert [" ".join(line.split()[:2]) for line in text("uavs").splitlines()] == [
            "A fly",
            "B none",
        ]
        assert "79 %" in text("uavs")
        seen = driver.execute_script(COLOURS)
        assert {"0,114,178", "213,94,0"} <= {*seen}, seen  # both darts in their colours
        assert (
            seen["0,114,178"] > seen["213,94,0"]
        )  # that of A, with the ring at its goal and the way there
        report(fleets, "B", 9)
        wait(lambda _: "71 %" in text("uavs"))
        driver.save_screenshot(str(tmp_path / "map.png"))
        assert [line for line in problems(driver) if "401" not in line] == []  # of the wrong token
