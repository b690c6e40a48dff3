"""docs/your-own-study.md is true."""

import re
from pathlib import Path

import numpy as np

GUIDE = (Path(__file__).parents[2] / "docs" / "your-own-study.md").read_text()
CODE = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)


def test_the_study_of_the_guide_runs_in_25_lines(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    world, study, _ = CODE
    lines = [line for line in (world + study).splitlines() if line.strip()]
    calls = [line for line in study.splitlines() if line.strip()]
    assert len(calls) <= 25
    assert len(lines) <= 45
    space: dict = {}
    few = study.replace("runs=1000", "runs=8").replace("Tuning()", "Tuning(runs=2, steps=3)")
    few = few.replace("[0, 1, 2, 4, 7, 10]", "[4, 10]")
    exec(compile(world + few, "your-own-study.md", "exec"), space)
    assert "difference" in capsys.readouterr().out
    assert (tmp_path / "delay.png").exists()
    page = (tmp_path / "report.html").read_text()
    assert "<svg" in page
    # One file: nothing is asked of the net.
    assert not re.findall(r"(?:src|href)=['\"](?!#|data:)", page)
    table = space["comparison"].table(reference="drop").set_index(["delay", "method"])
    assert table.loc[(10.0, "Al1"), "difference"] < 0
    assert np.isfinite(table["difference_error"]).all()
    assert table.loc[(4.0, "EWIF"), "without"] > 0
