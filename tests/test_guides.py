"""The guides are true: what they tell to add is all that is needed, and as much as they say.

Each is followed in a copy of the repository, whose own tests then judge what was added.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import xarray as xr

import ewif_jax as ej

ROOT = Path(__file__).parents[1]
FILE = re.compile(r"^New file `(.+?)`:\n\n```python\n(.*?)```", re.DOTALL | re.MULTILINE)
LINES = re.compile(
    r"^In `(.+?)`, after the line `(.+?)`:\n\n```diff\n(.*?)```", re.DOTALL | re.MULTILINE
)
CLAIMED = re.compile(r"(\d+)\s+lines\s+for\s+the\s+\w+\s+below,\s+and\s+(\d+)\s+elsewhere")


class Followed(NamedTuple):
    """A copy of the repository in which a guide was followed, and the lines that took: of new
    files, and in old ones."""

    tree: Path
    new: int
    elsewhere: int


def guide(name: str) -> str:
    return (ROOT / "docs" / f"adding-a-{name}.md").read_text()


def follow(text: str, tree: Path) -> Followed:
    for part in ("ewif_jax", "tests", "docs"):
        ignored = shutil.ignore_patterns("__pycache__", ".hypothesis")
        shutil.copytree(ROOT / part, tree / part, ignore=ignored)
    shutil.copy(ROOT / "pyproject.toml", tree)
    new = elsewhere = 0
    for path, block in FILE.findall(text):
        (tree / path).parent.mkdir(exist_ok=True)
        assert not (tree / path).exists(), path
        (tree / path).write_text(block)
        new += block.count("\n")
    for path, anchor, added in LINES.findall(text):
        block = re.sub(r"^\+", "", added, flags=re.MULTILINE)
        lines = (tree / path).read_text().splitlines(keepends=True)
        assert lines.count(f"{anchor}\n") == 1, f"{path}: {anchor}"
        lines.insert(lines.index(f"{anchor}\n") + 1, block)
        (tree / path).write_text("".join(lines))
        elsewhere += block.count("\n")
    return Followed(tree, new, elsewhere)


def do(tree: Path, *command: str) -> str:
    """What a command of Python says in the copy, where it must succeed."""
    environment = {**os.environ, "PYTHONPATH": f"{tree}:{tree / 'tests'}"}
    done = subprocess.run(
        [sys.executable, "-m", *command],
        cwd=tree, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def do_tests(tree: Path, which: str, *files: str) -> None:
    out = do(tree, "pytest", "-p", "no:cacheprovider", "-p", "no:xdist", "-k", which, *files)
    assert "passed" in out


@pytest.fixture(params=["filter", "sensor", "study"])
def followed(request, tmp_path):
    text = guide(request.param)
    found = follow(text, tmp_path)
    claimed = CLAIMED.search(text)
    assert claimed is not None
    assert (found.new, found.elsewhere) == tuple(map(int, claimed.groups()))
    return request.param, found.tree


def test_a_guide_adds_what_it_says_and_nothing_else_is_needed(followed):
    what, tree = followed
    do(tree, "ruff", "check", ".")
    do(tree, "ruff", "format", "--check", ".")
    if what == "filter":
        do_tests(tree, "constant_gain", "tests/contracts/test_contract.py")
        do_tests(tree, "constant_gain or public", "tests/test_architecture.py")
    elif what == "sensor":
        do_tests(tree, "signal_strength", "tests/test_sensors.py", "tests/test_architecture.py")
    else:
        do_tests(tree, "left_out", "tests/test_architecture.py")
        do(tree, "ewif_jax", "study", "left-out", "--quick", "--out", "found")
        results = tree / "found" / "left-out"
        names = {path.name for path in results.iterdir()}
        assert names == {"about.json", "error.csv", "error.nc", "error.png"}
        rmse = xr.load_dataset(results / "error.nc", engine="h5netcdf")["rmse"].values
        assert rmse[-1] > rmse[0]  # few runs: neighbours may change places


def test_a_sensor_of_ones_own_is_filtered():
    (example,) = re.findall(r"```python\n(import.*?)```", guide("sensor"), re.DOTALL)
    space: dict = {}
    exec(compile(example, "adding-a-sensor.md", "exec"), space)
    stream = ej.stream(np.arange(3.0), np.array([0.1, 0.2, 0.25]))
    prior = ej.Gaussian(np.array([10.0, 1.0, 0.0, 0.5]), np.eye(4))
    trace = ej.run(space["estimator"], {"noise": 0.1}, stream, prior=prior, t0=0.0)
    assert np.isfinite(trace.mean).all()


LINK = re.compile(r"\[[^\]]*\]\(([^)#\s]+)(?:#[^)]*)?\)")


def test_the_examples_of_tuning_find_what_they_say():
    page = (ROOT / "docs" / "tuning.md").read_text()
    space: dict = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(compile(block, "tuning.md", "exec"), space)
    latency, errors = space["tuned"].params["latency"], space["errors"]
    assert errors["latency"] < 0.05
    assert abs(latency - 0.4) < 3 * errors["latency"]


FOLDERS = ("benchmarks", "docs", "ewif_jax", "notebooks")
PAGES = sorted([*ROOT.glob("*.md"), *(page for x in FOLDERS for page in ROOT.glob(f"{x}/**/*.md"))])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_links_to_is_there(page):
    for target in LINK.findall(page.read_text()):
        if not target.startswith(("http:", "https:")):
            assert (page.parent / target).exists(), target


NAMED = re.compile(r"docs/[\w./-]+\.md")
SOURCES = sorted([*ROOT.glob("ewif_jax/**/*.py"), *ROOT.glob("tests/**/*.py")])


def test_the_pages_that_code_names_are_there():
    for source in SOURCES:
        for page in NAMED.findall(source.read_text()):
            assert (ROOT / page).exists(), f"{source.name}: {page}"


CHOICE = re.compile(r"^\|[^|]*\| `(.+?)` \|.*\| (\d+) \|$", re.MULTILINE)
KEPT = CHOICE.findall((ROOT / "docs" / "choosing-a-filter.md").read_text())


def test_each_choice_keeps_as_many_numbers_as_the_table_says():
    sensor = ej.models.position_sensor(0.5, dims=2)
    space = {
        **{name: getattr(ej, name) for name in ej.__all__},
        "ej": ej,
        "model": ej.models.constant_velocity(dims=2, q=0.1, sensors=sensor),
        "tau": 2.0,
        "window": 3.0,
        "limit": 3.0,
    }
    assert len(KEPT) == 29
    found = {call: ej.storage(eval(call, dict(space)), 4).numbers for call, _ in KEPT}
    assert found == {call: int(numbers) for call, numbers in KEPT}


def test_every_decision_has_its_day_and_every_page_its_place_in_the_index():
    folder = ROOT / "docs" / "decisions"
    index = (folder / "README.md").read_text()
    for page in sorted(folder.glob("*.md")):
        if page.name != "README.md":
            entries = re.findall(r"^## .+\n\n(.*)", page.read_text(), re.MULTILINE)
            assert all(re.match(r"\*\d{4}-\d\d-\d\d\.\* ", entry) for entry in entries), page.name
            assert re.search(rf"\({page.name}\) \| .+: {len(entries)} entries \|", index), page.name
