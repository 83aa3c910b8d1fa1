"""Every page of the documentation site in a real browser, on a wide screen and on a telephone.

Run by `make test-site`.
"""

import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest
from chromium import chromium, problems, resize
from sites import build

pytestmark = pytest.mark.browser
WAIT = """
const done = arguments[0];
Promise.all([document.fonts.ready, ...[...document.images].map((each) => each.decode().catch(() => 0))])
  .then(() => requestAnimationFrame(() => done()))
"""
LOOK = """
const article = document.querySelector('article');
const right = Math.min(article.parentElement.getBoundingClientRect().right, innerWidth) + 1;
const scrolls = (each) => each !== article && (scrolls(each.parentElement)
  || (each.getBoundingClientRect().right <= right && /auto|scroll/.test(getComputedStyle(each).overflowX)));
const wide = [...article.querySelectorAll('*')].filter(
  (each) => each.getBoundingClientRect().right > right && !scrolls(each));
return {
  broken: [...document.images].filter((each) => !each.naturalWidth).map((each) => each.src),
  wide: [...wide.map((each) => each.outerHTML.slice(0, 100)), document.documentElement.scrollWidth]
    .filter((each) => typeof each === 'string' || each > innerWidth),
}
"""
"""What is wrong on a page; what lies in a box that scrolls is not wide."""


class Quiet(SimpleHTTPRequestHandler):
    """Serves a folder, and says nothing."""

    def log_message(self, format, *args):
        pass


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the site, and where it is served; that its links lead somewhere: test_site.py."""
    folder = build(tmp_path_factory.mktemp("site"))
    server = ThreadingHTTPServer(("localhost", 0), partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield folder, f"http://localhost:{server.server_port}/"
    server.shutdown()
    server.server_close()


def pages(folder):
    """The addresses of the pages, relative to the site."""
    found = [
        path.relative_to(folder).parent.as_posix() for path in sorted(folder.rglob("index.html"))
    ]
    return [f"{name}/".removeprefix("./") for name in found]


@pytest.fixture(scope="module")
def seen(site):
    """What the browser sees of each page, by the width of the screen [px]."""
    folder, address = site
    with chromium() as driver:
        found = {}
        for width in (1440, 390):
            resize(driver, width)
            for name in pages(folder):
                driver.get(address + name)
                driver.execute_async_script(WAIT)
                found[name, width] = driver.execute_script(LOOK) | {"log": problems(driver)}
    return found


@pytest.mark.parametrize("problem", ["broken", "wide", "log"])
def test_no_page_has_a_broken_picture_a_part_wider_than_the_screen_or_an_error(seen, problem):
    assert len(seen) > 150
    assert {place: page[problem] for place, page in seen.items() if page[problem]} == {}
