"""The documentation site: each page is made, links lead somewhere, settings, names and examples are
there."""

import html
import posixpath
import re

import pytest
import yaml
from sites import DOCS, ROOT, anchors, build, generator, links, modules, pages

import damian
from damian.recipes.command import PROGRAMS
from damian.recipes.known import SCHEMAS, known_settings

EXCLUDED = (".py", ".csv")  # as mkdocs.yml says


def test_every_link_and_anchor_of_the_site_leads_somewhere():
    nowhere = []
    pictures = {*generator()["made"]()}
    for name, text in pages().items():
        for link in links(text):
            path, _, anchor = link.partition("#")
            target = (
                posixpath.normpath(posixpath.join(posixpath.dirname(name), path)) if path else name
            )
            if target in pages():
                there = not anchor or anchor in anchors(pages()[target], on_site=True)
            else:  # a picture, or a file that is offered as it is
                there = target in pictures or (
                    (DOCS / target).is_file() and not target.endswith(EXCLUDED)
                )
            nowhere += [] if there else [(name, link)]
    assert nowhere == []


def leaves(nav):
    """The pages of a navigation."""
    if isinstance(nav, str):
        yield nav
        return
    for entry in nav.values() if isinstance(nav, dict) else nav:
        yield from leaves(entry)


def test_the_navigation_has_pages_that_exist():
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]
    named = [*leaves([generator()["with_pages"](each) for each in nav])]
    assert len(named) > 80
    assert {*named} - {*pages()} == set()


def test_every_setting_program_and_example_has_a_place():
    for program in SCHEMAS:
        elsewhere = {} if program in {"compare", "train"} else known_settings("train")
        keys = {*known_settings(program)} - {*elsewhere}
        deep = [key for key in keys if not any(other.startswith(f"{key}.") for other in keys)]
        text = pages()[f"commands/{program}.md"]
        assert not [key for key in deep if f"<code>{html.escape(key)}</code>" not in text]
    assert all(f"## damian {name}\n" in pages()["commands/index.md"] for name in PROGRAMS)
    assert (
        "| <code>frames</code> | <code>int</code> | <code>300000</code> |"
        in pages()["commands/train.md"]
    )
    for example in {*(ROOT / "examples").rglob("*.py")} - {
        *(ROOT / "examples" / "fleet").rglob("*")
    }:
        text = pages()[f"examples/{example.relative_to(ROOT / 'examples').as_posix()}.md"]
        assert example.read_text("utf-8") in text


def test_every_public_name_leads_to_what_documents_it():
    documented = {each for text in pages().values() for each in modules(text)}
    named = dict(re.findall(r"\[`(\w+)`\]\[([\w.]+)\]", pages()["api/index.md"]))
    assert [*named] == sorted(damian._MODULE_OF)
    assert {
        path for path in named.values() if not {path, path.rpartition(".")[0]} & documented
    } == set()


@pytest.mark.slow
def test_the_site_is_built_without_a_warning_and_loads_nothing_from_elsewhere(tmp_path):
    pytest.importorskip("mkdocs")
    build(tmp_path)

    def page(name):
        return (tmp_path / name / "index.html").read_text()

    assert "ActionHistory" in page("api/transforms")
    for picture, page_name in (
        ("images/flight.gif", "."),
        ("results/delaybench/matrix.png", "report"),
    ):
        assert (tmp_path / picture).stat().st_size > 10_000
        assert picture in page(page_name)
    loaded = [each for each in page(".").split('"') if each.startswith("http")]
    assert not [each for each in loaded if each.endswith((".js", ".css", ".woff2"))]
