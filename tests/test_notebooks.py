"""Every notebook runs from top to bottom."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parent.parent / "notebooks"


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ipynb")), ids=lambda path: path.stem)
def test_notebook_runs(path):
    notebook = nbformat.read(path, as_version=4)
    executed = NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    cells = [cell for cell in executed.cells if cell.cell_type == "code"]
    assert cells
    assert all(cell.execution_count for cell in cells)
