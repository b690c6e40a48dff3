"""Runs notebooks from top to bottom and keeps what they print and draw, as small as it can be.

usage: python notebooks/execute.py [notebooks/03-tune.ipynb ...]   (all, if none is named)
"""

import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).parent
MOST = 150_000
"""Bytes of a notebook with its figures: they are kept in the repository."""
KEPT = ("image/png", "text/plain")


def cleaned(output: dict) -> dict | None:
    """An output without what changes from run to run; None if nothing is left of it."""
    if output["output_type"] == "stream":
        return None if output["name"] == "stderr" else output
    data = {kind: output["data"][kind] for kind in KEPT if kind in output["data"]}
    if "image/png" in data:
        data["image/png"] = data["image/png"].replace("\n", "")
        data.pop("text/plain", None)  # the address of a figure
    return nbformat.from_dict({**output, "data": data, "metadata": {}})


def execute(path: Path) -> None:
    """Runs one notebook where it lies."""
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(
        notebook, timeout=600, kernel_name="python3", record_timing=False, coalesce_streams=True,
        resources={"metadata": {"path": str(HERE)}},
    ).execute()  # fmt: skip
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number:02d}"
        cell["metadata"] = {}
        if cell.cell_type == "code":
            kept = (cleaned(output) for output in cell.outputs)
            cell.outputs = [output for output in kept if output is not None]
    nbformat.validate(notebook)
    nbformat.write(notebook, path)
    size = path.stat().st_size
    print(f"{path.name}: {size / 1000:.0f} kB")
    if size > MOST:
        raise SystemExit(f"{path.name} is larger than {MOST / 1000:.0f} kB: draw less, or smaller")


if __name__ == "__main__":
    for name in sys.argv[1:] or sorted(HERE.glob("*.ipynb")):
        execute(Path(name))
