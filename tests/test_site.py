"""The documentation site: it is built without a warning, and has every setting, public name and example."""

import pytest
from sites import ROOT, build

import damian
from damian.recipes.command import PROGRAMS
from damian.recipes.known import SCHEMAS, known_settings

pytestmark = pytest.mark.slow
pytest.importorskip("mkdocs")


def test_the_site_is_built_without_a_warning_and_is_complete(tmp_path):
    build(tmp_path)

    def page(name):
        return (tmp_path / name / "index.html").read_text()

    for program in SCHEMAS:
        text = page(f"commands/{program}")
        keys = {*known_settings(program)} - (
            {*known_settings("train")} if program not in {"compare", "train"} else set()
        )
        deep = [key for key in keys if not any(other.startswith(f"{key}.") for other in keys)]
        assert not [key for key in deep if f"<code>{key}</code>" not in text]
    assert all(f"damian {name}" in page("commands") for name in PROGRAMS)
    assert all(name in page("api") for name in damian._MODULE_OF)
    assert "ActionHistory" in page("api/transforms")
    for example in {*(ROOT / "examples").rglob("*.py")} - {*(ROOT / "examples" / "fleet").rglob("*")}:
        assert example.stem in page(f"examples/{example.relative_to(ROOT / 'examples').as_posix()}")
    for picture, page_name in (("images/flight.gif", "."), ("results/delaybench/curves.png", "report")):
        assert (tmp_path / picture).stat().st_size > 10_000
        assert picture in page(page_name)
    loaded = [each for each in (tmp_path / "index.html").read_text().split('"') if each.startswith("http")]
    assert not [each for each in loaded if each.endswith((".js", ".css", ".woff2"))]
