"""The README's Python runs as printed."""

import re
from pathlib import Path

README = Path(__file__).parent.parent / "README.md"


def test_the_readmes_code_runs():
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(blocks) == 2
    space: dict = {}
    for block in blocks:
        exec(compile(block, str(README), "exec"), space)
    assert space["trace"].info.status.tolist() == [0, 0, 1, 0]
    assert abs(float(space["tuned"].params["tau"]) - 0.467) < 0.05
    value, error = space["statistics"].root("squared_error")
    assert abs(value - 0.2996) < 4 * error
