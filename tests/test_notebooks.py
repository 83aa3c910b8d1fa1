"""The notebooks run from their first cell to the last, and are stored with what they show."""

from pathlib import Path

import pytest

import damian

pytestmark = pytest.mark.slow
nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
NOTEBOOKS = sorted((Path(damian.__file__).parents[1] / "docs" / "notebooks").glob("*.ipynb"))
SHOWN = {
    "from_map_to_film": "flight.html: ",
    "late_pendulum": "aware: {",
    "one_policy_every_delay": "timeline+gru, 1 to 7: 25.7 to 31.2 under 16 laws",
}


def texts_and_pictures(notebook):
    """What the outputs of a notebook say, and how many pictures they have."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    pictures = sum("image/png" in output.get("data", {}) for output in outputs)
    return "".join(output.get("text", "") for output in outputs), pictures


def test_every_notebook_is_known():
    assert [path.stem for path in NOTEBOOKS] == sorted(SHOWN)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_shows_what_is_stored(path):
    notebook = nbformat.read(path, as_version=4)
    stored = texts_and_pictures(notebook)
    nbclient.NotebookClient(notebook, resources={"metadata": {"path": str(path.parent)}}).execute()
    for text, pictures in (stored, texts_and_pictures(notebook)):
        assert SHOWN[path.stem] in text
        assert pictures == 1
