"""Replay pages: one HTML file that plays one or more episodes, and needs no network.

An import map names every module of ``page/`` as a data URL, so that each stays an ordinary module.
"""

import html
import json
import re
from collections.abc import Sequence
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

from damian.common.atomic_files import write_atomically
from damian.common.plotting import UAV_COLOURS
from damian.show.episode import LIKELY, Episode

PAGE = Path(__file__).parent / "page"
"""Folder of the modules and the style, for pages that draw the same."""
_LIBRARIES = "libraries.min.js"
_PLAIN = " !$&'()*+,-./:;<=>?@[]^_`{|}~\\\""
"""Characters that a data URL may hold as they are."""
_TOLD = ("policy", "checkpoint", "seed", "world", "fleet")
"""What ``about`` says about an episode's flight, beside the overrides."""
_NOT_FLOWN = (*_TOLD, "hydra", "formats", "shown", "keep", "eval_episodes")
"""Overrides that say nothing of how an episode was flown, or that ``about`` repeats."""


def save_page(episodes: Sequence[Episode], path: Path) -> None:
    """Write a page that plays episodes side by side, on one time line."""
    write_atomically(path, page(episodes))


def page(episodes: Sequence[Episode]) -> str:
    """The text of a page that plays episodes."""
    shared, names = titles(episodes)
    shown = [
        {"title": name, **episode.document()} for name, episode in zip(names, episodes, strict=True)
    ]
    replay = {"colours": UAV_COLOURS, "likely": LIKELY, "shared": shared, "episodes": shown}
    modules = {  # as data URLs, by the names by which they import each other
        "libraries" if file.name == _LIBRARIES else f"page/{file.stem}": (
            f"data:text/javascript;charset=utf-8,{quote(_text(file.name), safe=_PLAIN)}"
        )
        for file in sorted(PAGE.glob("*.js"))
    }
    return Template(_text("index.html")).substitute(
        title=_title([shared, *names]),
        licences=_text("LICENSES.txt"),
        style="\n".join(map(_text, ("uplot.css", "style.css"))),
        modules=_in_script({"imports": modules}),
        replay=_in_script(replay),
    )


def titles(episodes: Sequence[Episode]) -> tuple[str, list[str]]:
    """The settings that all episodes share, and those that tell each from the others; one has all
    of them."""
    settings = [_settings(episode) for episode in episodes]
    if len(settings) == 1:
        return "", [" ".join(settings[0]) or "episode"]
    shared = [word for word in settings[0] if all(word in words for words in settings)]
    own = [" ".join(word for word in words if word not in shared) for words in settings]
    if len({*own}) < len(own):  # they tell nothing, or not all
        own = [f"episode {number} {words}".strip() for number, words in enumerate(own, 1)]
    others = " ".join(dict.fromkeys(word for words in own for word in words.split()))
    return " ".join(shared), [words or f"without {others}" for words in own]


def _settings(episode: Episode) -> list[str]:
    """How an episode was flown, as words KEY=VALUE."""
    about = episode.about
    words = [str(word).lstrip("+") for word in about.get("overrides") or []]
    flown = [word for word in words if re.split(r"[.=]", word)[0] not in _NOT_FLOWN]
    return flown + [f"{key}={about[key]}" for key in _TOLD if about.get(key) is not None]


def _text(name: str) -> str:
    return (PAGE / name).read_text(encoding="utf-8").strip()


def _title(parts: Sequence[str]) -> str:
    """The page's title as HTML; lone surrogates, which JSON may hold, have no other form."""
    return (
        html.escape(" | ".join(filter(None, parts))).encode("ascii", "xmlcharrefreplace").decode()
    )


def _in_script(values: Any) -> str:
    """JSON that no HTML parser can take for the end of its script."""
    return json.dumps(values, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
