"""Replay pages as files: what they hold, and that they need nothing else."""

import json
import re
from html.parser import HTMLParser

import numpy as np
from episodes import flight

from damian.common.plotting import UAV_COLOURS
from damian.show.replay_page import page, save_page

EVIL = "scenario=</script><script>alert('&\"\ud800')</script><!--"


class Parts(HTMLParser):
    """The texts of a page's elements, as a browser separates them."""

    def __init__(self, text):
        super().__init__()
        self.found = []
        self.comments = []
        self.tags = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.found.append((tag, dict(attrs), ""))

    def handle_data(self, data):
        tag, attrs, text = self.found.pop() if self.found else ("", {}, "")
        self.found.append((tag, attrs, text + data))

    def handle_comment(self, data):
        self.comments.append(data)

    def text(self, tag, **attrs):
        """The text of the only element of a kind with these attributes."""
        (text,) = [t for name, own, t in self.found if name == tag and attrs.items() <= own.items()]
        return text


def flown_with(*overrides):
    """Episodes that differ in their overrides."""
    about = {"policy": "script", "checkpoint": None, "seed": 2, "world": 0}
    return [flight(about={**about, "overrides": list(words)}) for words in overrides]


def test_a_page_holds_the_episodes_as_their_files_do(tmp_path):
    shown = flown_with(["delay=none", "agents=2"], ["delay=burst", "agents=2"])
    save_page(shown, tmp_path / "page.html")
    replay = json.loads(Parts((tmp_path / "page.html").read_text()).text("script", id="replay"))
    assert replay["colours"] == list(UAV_COLOURS)
    for episode, held in zip(shown, replay["episodes"], strict=True):
        episode.save(tmp_path / "episode.json")
        assert {
            **json.loads((tmp_path / "episode.json").read_text()),
            "title": held["title"],
        } == held


def test_a_page_is_small_and_loads_nothing():
    rng = np.random.default_rng(0)
    steps = 150
    cells = 256
    belief = rng.dirichlet(np.ones(cells), (steps + 1, 1))
    ordinary = flight(
        steps,
        cells=rng.uniform(-200, 200, (cells, 2)),
        belief=belief,
    )
    text = page([ordinary])
    assert len(text.encode()) < 2_000_000
    parts = Parts(text)
    assert not [attrs for _, attrs in parts.tags if {"src", "href", "srcset", "action"} & {*attrs}]
    (policy,) = [attrs["content"] for _, attrs in parts.tags if "http-equiv" in attrs]
    assert policy.startswith("default-src 'none';")
    assert "http" not in policy
    assert not re.search(r"@import|url\(", parts.text("style"))


def test_names_of_any_text_stay_text():
    text = page(flown_with([EVIL], ["agents=2"]))
    parts = Parts(text.encode().decode())
    assert [tag for tag, _ in parts.tags].count("script") == 3
    assert len(parts.comments) == 1
    held = json.loads(parts.text("script", id="replay"))
    assert held["episodes"][0]["title"] == EVIL
    assert "alert" in parts.text("title")
