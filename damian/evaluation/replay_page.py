"""Replay pages: one HTML file that plays one or more episodes, needs no network, and lies beside them.

The page's own files are in ``page/``: a template, a style and ES modules, and the libraries that
``make page-libraries`` has bundled. Here they are put into one file: an import map names every module as a
data URL, so that each stays an ordinary module.
"""

import html
import json
from collections.abc import Sequence
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

from damian.common import checks
from damian.common.atomic_files import write_atomically
from damian.evaluation.belief_figure import COLOURS
from damian.evaluation.episode import LIKELY, Episode

MOST = 12
"""Largest number of episodes on a page: browsers draw no more views of the space at once."""
_PAGE = Path(__file__).parent / "page"
_LIBRARIES = "libraries.min.js"
_PLAIN = " !$&'()*+,-./:;<=>?@[]^_`{|}~\\\""
"""Characters that a data URL may hold as they are."""
_NO_PART_OF_THE_FLIGHT = ("hydra", "formats", "views", "keep", "eval_episodes", "seed", "policy", "checkpoint")
"""Settings that say nothing about how an episode was flown, or that its ``about`` repeats."""


def save_page(episodes: Sequence[Episode], path: Path) -> None:
    """Write a page that plays episodes side by side, on one time line.

    Raises:
        InputError: there are no episodes, or more than ``MOST``.
        RunError: the file cannot be written.
    """
    write_atomically(path, page(episodes))


def page(episodes: Sequence[Episode]) -> str:
    """The text of a page that plays episodes.

    Raises:
        InputError: there are no episodes, or more than ``MOST``.
    """
    checks.in_range("episodes", len(episodes), 1, MOST)
    names = titles(episodes)
    shown = [{"title": name, **episode.document()} for name, episode in zip(names, episodes, strict=True)]
    replay = {"colours": COLOURS, "likely": LIKELY, "episodes": shown}
    return Template((_PAGE / "index.html").read_text()).substitute(
        title=html.escape(" | ".join(names)),
        licences=(_PAGE / "LICENSES.txt").read_text(),
        style="\n".join((_PAGE / name).read_text() for name in ("uplot.css", "style.css")),
        modules=_in_script({"imports": _modules()}),
        replay=_in_script(replay),
    )


def titles(episodes: Sequence[Episode]) -> list[str]:
    """What tells each episode from the others: the settings that not all of them share."""
    settings = [_settings(episode) for episode in episodes]
    shared = set.intersection(*map(set, settings))
    own = [" ".join(each for each in words if each not in shared) for words in settings]
    if len({*own}) < len(own):  # they tell nothing, or not all
        return [f"episode {number} {words}".strip() for number, words in enumerate(own, 1)]
    return [words or "other settings by default" for words in own]


def _settings(episode: Episode) -> list[str]:
    """How an episode was flown, as words KEY=VALUE."""
    about = episode.about
    words = [str(word) for word in about.get("overrides") or []]
    own = [word for word in words if word.lstrip("+").partition("=")[0].partition(".")[0] not in _NO_PART_OF_THE_FLIGHT]
    named = [f"{key}={about[key]}" for key in ("policy", "checkpoint", "seed", "world") if about.get(key) is not None]
    return [*own, *named]


def _modules() -> dict[str, str]:
    """The page's modules as data URLs, by the names by which they import each other."""
    files = sorted(_PAGE.glob("*.js"))
    names = {file: "libraries" if file.name == _LIBRARIES else f"page/{file.stem}" for file in files}
    return {name: f"data:text/javascript;charset=utf-8,{_encoded(file)}" for file, name in names.items()}


def _encoded(file: Path) -> str:
    return quote(file.read_text().strip(), safe=_PLAIN)


def _in_script(values: Any) -> str:
    """JSON that no HTML parser can take for the end of its script."""
    return json.dumps(values, separators=(",", ":")).replace("<", "\\u003c")
