"""The notebooks run from their first cell to the last, and show something."""

from pathlib import Path

import pytest

import damian

pytestmark = pytest.mark.slow
nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
NOTEBOOKS = sorted((Path(damian.__file__).parents[1] / "docs" / "notebooks").glob("*.ipynb"))
SHOWN = {
    "delaybench_tables": "better in 7 of 7 seeds",
    "delays_on_pendulum": "age of the observation",
    "from_map_to_film": "flight.html: ",
}


def test_every_notebook_is_known():
    assert [path.stem for path in NOTEBOOKS] == sorted(SHOWN)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
    assert not [cell for cell in notebook.cells if cell.get("outputs")]
    nbclient.NotebookClient(notebook, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert SHOWN[path.stem] in "".join(output.get("text", "") for output in outputs)
    figures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(figures) == (path.stem != "delaybench_tables")
