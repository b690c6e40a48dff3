"""The pages of the site: their Python runs and prints what it says; every public name is on one."""

import contextlib
import io
import re
from pathlib import Path

from apart import apart

import ewif_jax as ej

DOCS = Path(__file__).parents[1] / "docs"
# The first asks for settings that have to come before anything is computed.
PAGES = ("prepare-cpu", "performance", "index", "quickstart")
ROOMS = ("analysis", "continuous", "lab", "losses", "models", "scenarios")
DOCUMENTED = re.compile(r"^::: ewif_jax\.([\w.]+)$", re.MULTILINE)


def printed() -> list[tuple[str, str]]:
    """What the lines of the pages say that they print, and what they print."""
    pairs = []
    for page in PAGES:
        space: dict = {}
        for block in re.findall(r"```python\n(.*?)```", (DOCS / f"{page}.md").read_text(), re.S):
            out = io.StringIO()
            with contextlib.redirect_stdout(out):
                exec(compile(block, f"{page}.md", "exec"), space)
            said = re.findall(r"^print\(.*\)  # (.*)$", block, re.MULTILINE)
            pairs += (
                zip(said, out.getvalue().splitlines()[-len(said) :], strict=True) if said else []
            )
    return pairs


def test_a_line_of_a_page_prints_what_it_says():
    pairs = apart(printed, double=False)
    assert len(pairs) == 8
    for said, found in pairs:
        assert found == said


def test_every_public_name_is_on_one_page():
    named = [
        name
        for page in (DOCS / "api").glob("*.md")
        for name in DOCUMENTED.findall(page.read_text())
    ]
    assert len(named) == len(set(named))
    flat = set(ej.__all__) - {*ROOMS, "scores", "transforms"}
    of_rooms = {f"{room}.{name}" for room in ROOMS for name in getattr(ej, room).__all__}
    at_home = {name for name in of_rooms if name.rpartition(".")[2] not in flat}
    assert set(named) >= flat | at_home
    for name in named:
        found = ej
        for part in name.split("."):
            found = getattr(found, part)
