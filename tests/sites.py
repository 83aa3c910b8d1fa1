"""The documentation site for tests: its pages, where their links lead, and how it is built."""

import os
import re
import runpy
import subprocess
import sys
from functools import cache
from pathlib import Path

from markdown.extensions.toc import slugify

import damian

ROOT = Path(damian.__file__).parents[1]
DOCS = ROOT / "docs"


@cache
def generator():
    """The names that docs/pages.py defines."""
    return runpy.run_path(str(DOCS / "pages.py"))


@cache
def pages():
    """The text of each page of the site, made ones included, with its links as the site has
    them."""
    texts = {path.name: path.read_text("utf-8") for path in DOCS.glob("*.md")}
    texts |= {name: text for name, text in generator()["made"]().items() if isinstance(text, str)}
    return {name: generator()["led"](text, name) for name, text in texts.items()}


def links(text):
    """Where links and pictures of a Markdown text lead to, but for other sites."""
    without_code = re.sub(r"`[^`]*`", "", _without_fences(text))
    found = re.findall(r"\]\(([^)\s]+)[^)]*\)|src=\"([^\"]+)\"", without_code)
    return {link or image for link, image in found if not re.match(r"\w+:", link or image)}


def anchors(text, on_site=False):
    """The places of a Markdown text that a link may name, as MkDocs or as GitHub writes them."""
    headings = re.findall(r"^#+ +(.*)", _without_fences(text), re.MULTILINE)
    titles = [re.sub(r"\[([^]]*)\]\([^)]*\)|`", r"\1", heading) for heading in headings]
    if on_site:
        return {slugify(title, "-") for title in titles} | {*modules(text)}
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


def modules(text):
    """What a page of the API documents."""
    return re.findall(r"^::: (\S+)", text, re.MULTILINE)


def _without_fences(text):
    return re.sub(r"^ *(`{3,}).*?^ *\1 *$", "", text, flags=re.DOTALL | re.MULTILINE)


def build(folder):
    """The site, built in this folder without a warning."""
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return folder
