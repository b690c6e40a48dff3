"""The page for those who come from other libraries: its code runs and prints what it says."""

import importlib.util
import io
import re
import warnings
from contextlib import redirect_stdout
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[1] / "docs" / "coming-from.md").read_text()
SECTIONS = dict(re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE))
CODE = {
    name: "".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))
    for name, text in SECTIONS.items()
    if "```python" in text
}


def test_every_library_has_its_section_and_every_adapter_its_code():
    named = {"FilterPy", "pykalman", "dynamax", "cuthbert", "Stone Soup", "MATLAB"}
    assert named <= set(SECTIONS)
    assert set(CODE) == {"FilterPy", "pykalman", "dynamax"}


@pytest.mark.parametrize("library", CODE)
def test_the_code_prints_what_it_says(library):
    if importlib.util.find_spec(library.lower()) is None:
        pytest.skip(f"{library} is not installed")
    said, code = io.StringIO(), CODE[library]
    with redirect_stdout(said), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of what dynamax imports
        exec(compile(code, f"coming-from.md, {library}", "exec"), {})
    assert said.getvalue().splitlines() == re.findall(r"^print\(.*\)  # (.+)$", code, re.MULTILINE)


def test_what_is_said_to_be_ours_is_there():
    import ewif_jax as ej

    for name in re.findall(r"`ej\.([\w.]+)", PAGE):
        found = ej
        for part in name.split("."):
            found = getattr(found, part)
