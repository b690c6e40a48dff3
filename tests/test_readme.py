"""The README's Python runs, prints what it says, and hides no name of Python's."""

import builtins
import contextlib
import io
import re
from pathlib import Path

from apart import apart

README = (Path(__file__).parents[1] / "README.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


def printed() -> tuple[list[str], list[str], list[str]]:
    """What the README says that its lines print, what they print, and the names they make."""
    space: dict = {}
    said, out = [], io.StringIO()
    with contextlib.redirect_stdout(out):
        for block in BLOCKS:
            said += re.findall(r"^print\(.*\)  # (.*)$", block, re.MULTILINE)
            exec(compile(block, "README.md", "exec"), space)
    return said, out.getvalue().splitlines(), sorted(space)


def test_a_line_prints_what_it_says():
    said, found, names = apart(printed, double=False)
    assert len(said) == 4
    assert found == said
    assert not set(names) & set(dir(builtins)) - {"__builtins__"}


def test_it_is_read_in_one_sitting():
    assert README.count("\n") <= 120
