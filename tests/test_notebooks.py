"""Every notebook runs from top to bottom: two a day in turn, all of them with `--all`."""

import datetime
import json
import re
from importlib.util import find_spec
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parent.parent / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
TODAY = datetime.datetime.now(datetime.UTC).toordinal()
TURN = {(2 * TODAY + k) % len(NOTEBOOKS) for k in (0, 1)}
"""Whose turn it is on this day (UTC), by number. Of fifteen each comes every eighth day or so."""
OPTIONAL = {"blackjax": "bayes"}
"""Extras that the tests do not install, by what a notebook imports of them."""
MOST = 150_000


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=[] if number in TURN else pytest.mark.slow, id=path.stem)
        for number, path in enumerate(NOTEBOOKS)
    ],
)
def test_notebook_runs(path):
    notebook = nbformat.read(path, as_version=4)
    for name, extra in OPTIONAL.items():
        asked = any(f"import {name}" in cell.source for cell in notebook.cells)
        if asked and find_spec(name) is None:
            pytest.skip(f"{name} is not installed (extra {extra})")
    here = {"metadata": {"path": str(FOLDER)}}
    client = NotebookClient(notebook, timeout=300, kernel_name="python3", resources=here)
    executed = client.execute()
    cells = [cell for cell in executed.cells if cell.cell_type == "code"]
    assert cells
    assert all(cell.execution_count for cell in cells)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_with_its_outputs_and_small(path):
    cells = json.loads(path.read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert all(cell["execution_count"] for cell in code)
    assert not any(output["output_type"] == "error" for cell in code for output in cell["outputs"])
    assert any("image/png" in output.get("data", {}) for cell in code for output in cell["outputs"])
    if path.stem[:2] not in ("01", "02"):
        assert path.stat().st_size < MOST


def test_every_notebook_is_on_the_site():
    nav = (FOLDER.parent / "mkdocs.yml").read_text()
    shown = re.findall(r"^ +- notebooks/(.+)\.md$", nav, re.MULTILINE)
    assert shown == ["index", *(path.stem for path in NOTEBOOKS)]
    table = re.findall(r"^\| \[.+?\]\((.+?)\)", (FOLDER / "README.md").read_text(), re.MULTILINE)
    assert table == [path.name for path in NOTEBOOKS]
