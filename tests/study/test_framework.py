"""Results appear whole, keep earlier ones, and finished pieces are not computed twice."""

import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ewif_jax.lab.timing import timed
from ewif_jax.study import cli
from ewif_jax.study.shared.experiment import Experiment, Measured, Options, shown_number
from ewif_jax.study.shared.folder import Folder


def finished(out, text, overwrite=False):
    folder = Folder(out, "study", {"seed": 0})
    folder.write("result.txt", lambda path: path.write_text(text))
    return folder.finish({"note": text}, overwrite)


def test_earlier_results_are_kept(tmp_path):
    assert finished(tmp_path, "first") is None
    assert finished(tmp_path, "second") == tmp_path / "study.1"
    assert finished(tmp_path, "third") == tmp_path / "study.2"
    kept = [
        (tmp_path / name / "result.txt").read_text() for name in ("study.1", "study.2", "study")
    ]
    assert kept == ["first", "second", "third"]


def test_overwrite_replaces(tmp_path):
    finished(tmp_path, "first")
    assert finished(tmp_path, "second", overwrite=True) is None
    assert [path.name for path in tmp_path.iterdir()] == ["study"]
    assert (tmp_path / "study" / "result.txt").read_text() == "second"


def test_an_interrupted_study_resumes(tmp_path):
    computed = []

    def compute(name):
        computed.append(name)
        return {"x": np.arange(3)}

    first = Folder(tmp_path, "study", {"seed": 0})
    first.piece("a", lambda: compute("a"))
    other = Folder(tmp_path, "study", {"seed": 1})
    other.piece("a", lambda: compute("other seed"))
    again = Folder(tmp_path, "study", {"seed": 0})
    np.testing.assert_array_equal(again.piece("a", lambda: compute("a"))["x"], np.arange(3))
    again.piece("b", lambda: compute("b"))
    assert computed == ["a", "other seed", "b"]
    assert again.resumed == ["a"]
    again.finish({}, overwrite=False)
    assert sorted(path.name for path in (tmp_path / "study").iterdir()) == ["about.json"]
    assert other.partial.exists()


def test_a_failed_write_leaves_nothing_under_its_name(tmp_path):
    def fail(path):
        path.write_text("half")
        raise RuntimeError("disk full")

    folder = Folder(tmp_path, "study", {})
    with pytest.raises(RuntimeError, match="disk full"):
        folder.write("table.csv", fail)
    assert not (folder.partial / "table.csv").exists()
    assert not folder.final.exists()


def test_compile_time_is_told_from_run_time():
    with timed() as first:
        program = jax.jit(lambda x: jnp.sin(x) @ jnp.cos(x))
        program(jnp.ones(1000)).block_until_ready()
    with timed() as second:
        program(jnp.ones(1000)).block_until_ready()
        time.sleep(0.05)
    assert first.compile > 0
    assert second.compile < 0.5 * first.compile
    assert second.run > 0.05


def test_table_cells():
    assert shown_number(Measured(0.30072, 0.00051)) == "0.30072 ± 0.00051"
    assert shown_number(Measured(123.456, 12.0)) == "123 ± 12"
    assert shown_number(Measured(1.5, float("nan"))) == "1.5"
    assert shown_number(None) == ""


def test_tables_are_saved_with_errors(tmp_path):
    experiment = Experiment("study", Options(out=tmp_path))
    experiment.table("t", "Title [s]", [{"name": "a [m]", "x": Measured(1.0, 0.5)}])
    experiment.finish()
    assert (tmp_path / "study" / "t.csv").read_text() == "name,x,x_se\na [m],1.0,0.5\n"


def test_missing_extra_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setattr(cli, "find_spec", lambda name: None if name == "rich" else object())
    assert cli.run(["study", "sine"]) == 1
    message = capsys.readouterr().err
    assert "rich" in message
    assert 'pip install "ewif_jax[study]"' in message


def test_module_is_the_command():
    done = subprocess.run(
        [sys.executable, "-m", "ewif_jax", "study", "--help"], capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    assert "sine" in done.stdout


@pytest.mark.parametrize("wrong", [["--runs", "1"], ["--runs", "many"], ["--chunk", "0"]])
def test_bad_options_are_refused(wrong, capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.run(["study", "sine", *wrong])
    assert stopped.value.code == 2
    assert "expected a whole number" in capsys.readouterr().err
