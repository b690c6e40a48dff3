"""Work on disk is never lost, mixed or silently overwritten."""

import errno
import io
import json
import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from ewif_jax.study import cli
from ewif_jax.study.shared.experiment import Experiment, Options
from ewif_jax.study.shared.folder import Folder
from ewif_jax.study.shared.refusal import Refused


def finished(out, text, overwrite=False, files=("table.csv",)):
    folder = Folder(out, "study", {"seed": 0})
    folder.claim(overwrite)
    for name in files:
        folder.write(name, lambda path: path.write_text(text))
    return folder, folder.finish({"note": text}, overwrite)


def contents(out):
    return {
        str(path.relative_to(out)): path.read_text()
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.name != "about.json"
    }


HOLDER = """
import fcntl, sys, time
file = open(sys.argv[1], "w")
fcntl.flock(file, fcntl.LOCK_EX)
print(file.write("4711"), file.flush(), flush=True)
time.sleep(60)
"""


def test_a_second_process_is_refused_and_a_dead_one_is_not_in_the_way(tmp_path):
    folder = Folder(tmp_path, "study", {})
    folder.partial.parent.mkdir()
    lock = folder.partial.with_name(f"{folder.partial.name}.lock")
    command = [sys.executable, "-c", HOLDER, str(lock)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as holder:
        holder.stdout.readline()
        for attempt in (folder.claim, lambda: folder.write("a", Path.touch)):
            with pytest.raises(Refused, match=r"another process \(4711\) works on the same study"):
                attempt()
        other = Folder(tmp_path, "study", {"seed": 1})
        other.claim()
        other.leave()
        holder.kill()
    folder.claim()
    folder.write("a", Path.touch)
    folder.finish({}, False)
    assert {p.name for p in tmp_path.iterdir()} == {"study"}


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_run_whose_folder_another_has_finished_stops(tmp_path, overwrite):
    first, second = (Folder(tmp_path, "study", {}) for _ in range(2))
    for folder in (first, second):
        folder.write("1.csv", lambda path: path.write_text("1"))
    first.finish({}, overwrite)
    for attempt in (
        lambda: second.write("2.csv", Path.touch),
        lambda: second.piece("p", lambda: {"a": 1}),
        lambda: second.finish({}, overwrite),
    ):
        with pytest.raises(Refused, match="another run has finished or removed it"):
            attempt()
    assert contents(tmp_path) == {"study/1.csv": "1"}


def test_a_result_that_went_missing_is_not_finished_without(tmp_path):
    folder = Folder(tmp_path, "study", {})
    folder.write("1.csv", Path.touch)
    (folder.partial / "1.csv").unlink()
    with pytest.raises(Refused, match=r"1\.csv went missing"):
        folder.finish({}, False)
    assert not folder.final.exists()


class Trap:
    def __reduce__(self):
        return (pytest.fail, ("unpickled",))


def saved(save, array):
    buffer = io.BytesIO()
    save(buffer, array)
    return buffer.getvalue()


DAMAGE = {
    "empty": lambda path, data: path.write_bytes(b""),
    "half": lambda path, data: path.write_bytes(data[: len(data) // 2]),
    "zeros": lambda path, data: path.write_bytes(bytes(len(data))),
    "zeros at the end": lambda path, data: path.write_bytes(data[:-64] + bytes(64)),
    "longer": lambda path, data: path.write_bytes(data + b"\0"),
    "text": lambda path, data: path.write_text("text"),
    "npy": lambda path, data: path.write_bytes(saved(np.save, np.arange(3))),
    "npz of another": lambda path, data: path.write_bytes(saved(np.savez, np.arange(3))),
    "pickle": lambda path, data: path.write_bytes(pickle.dumps(Trap())),
    "npz with a pickle": lambda path, data: path.write_bytes(
        saved(np.savez, np.array([Trap()], dtype=object))
    ),
    **{
        f"bit {k}": lambda path, data, k=k: path.write_bytes(
            data[:k] + bytes([data[k] ^ 1]) + data[k + 1 :]
        )
        for k in (0, 9, 31, 80, 200, 700, -80, -10, -1)
    },
}


def test_a_piece_that_is_not_whole_is_computed_again_and_said_so(tmp_path):
    right, calls = np.arange(100.0), []

    def compute():
        calls.append(1)
        return {"a": right}

    folder = Folder(tmp_path, "study", {})
    folder.piece("x", compute)
    path = folder.partial / "piece-x.npz"
    whole = path.read_bytes()
    for name, damage in DAMAGE.items():
        damage(path, whole)
        calls.clear()
        again = Folder(tmp_path, "study", {})
        np.testing.assert_array_equal(again.piece("x", compute)["a"], right, err_msg=name)
        assert (len(calls), again.broken, again.resumed) == (1, ["x"], []), name
        assert path.read_bytes() == whole
    again = Folder(tmp_path, "study", {})
    again.piece("x", compute)
    assert (again.broken, again.resumed) == ([], ["x"])


def test_a_broken_piece_is_said(tmp_path, capsys):
    with Experiment("study", Options(out=tmp_path)) as experiment:
        experiment.piece("x", lambda: {"a": 1})
        (experiment.folder.partial / "piece-x.npz").write_bytes(b"")
        experiment.piece("x", lambda: {"a": 1})
        assert "'x' was not whole; computed again" in capsys.readouterr().out


def test_files_are_on_the_disk_before_they_have_their_name(tmp_path, monkeypatch):
    done = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda fd: (done.append("flush"), fsync(fd)))
    monkeypatch.setattr(os, "replace", lambda a, b: (done.append("name"), replace(a, b)))
    Folder(tmp_path, "study", {}).piece("x", lambda: {"a": 1})
    assert done == ["flush", "name", "flush"]


def test_pieces_stay_until_the_result_is_in_place(tmp_path, monkeypatch):
    finished(tmp_path, "earlier")
    folder = Folder(tmp_path, "study", {"seed": 0})
    folder.piece("x", lambda: {"a": 1})
    folder.write("table.csv", lambda path: path.write_text("new"))
    replace = os.replace

    def fail(source, target):
        if Path(target) == folder.final and Path(source) == folder.partial:
            raise OSError(errno.ENOSPC, "full", str(target))
        return replace(source, target)

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="full"):
        folder.finish({}, True)
    assert (folder.final / "table.csv").read_text() == "earlier"
    monkeypatch.undo()
    again = Folder(tmp_path, "study", {"seed": 0})
    again.piece("x", lambda: pytest.fail("computed again"))
    again.write("table.csv", lambda path: path.write_text("new"))
    again.finish({}, True)
    assert contents(tmp_path) == {"study/table.csv": "new"}


def test_overwrite_deletes_only_what_this_program_wrote(tmp_path):
    finished(tmp_path, "first", files=("table.csv", "edited.csv", "gone.csv"))
    mine = tmp_path / "study"
    (mine / "thesis.tex").write_text("mine")
    (mine / "deep").mkdir()
    (mine / "deep" / "notes.txt").write_text("mine too")
    (mine / "edited.csv").write_text("first, with a remark")
    (mine / "gone.csv").unlink()
    (mine / "gone.csv").symlink_to(tmp_path / "elsewhere")
    folder, kept = finished(tmp_path, "second", overwrite=True, files=("table.csv", "edited.csv"))
    assert contents(tmp_path) == {
        "study/table.csv": "second",
        "study/edited.csv": "second",
        "study/thesis.tex": "mine",
        "study/deep/notes.txt": "mine too",
        "study.1/edited.csv": "first, with a remark",
    }
    assert kept == tmp_path / "study.1"
    assert (mine / "gone.csv").is_symlink()
    assert {path.name for path in folder.kept} == {"thesis.tex", "deep", "edited.csv", "gone.csv"}


def test_an_edited_description_is_kept(tmp_path):
    finished(tmp_path, "first")
    about = tmp_path / "study" / "about.json"
    about.write_text(about.read_text().replace("first", "my remark"))
    finished(tmp_path, "second", overwrite=True)
    assert json.loads((tmp_path / "study.1" / "about.json").read_text())["note"] == "my remark"
    assert json.loads(about.read_text())["note"] == "second"


FOREIGN = {
    "a thesis": {"thesis.tex": "mine"},
    "no list": {"about.json": "{}", "thesis.tex": "mine"},
    "not JSON": {"about.json": "about me"},
    "another program's": {"about.json": '{"files": {"thesis.tex": "abc"}}', "thesis.tex": "mine"},
}


@pytest.mark.parametrize("files", FOREIGN.values(), ids=FOREIGN)
def test_overwrite_refuses_a_folder_it_did_not_make(tmp_path, files):
    (tmp_path / "study").mkdir()
    for name, text in files.items():
        (tmp_path / "study" / name).write_text(text)
    with pytest.raises(Refused, match="study: --overwrite replaces only what this program"):
        Experiment("study", Options(out=tmp_path, overwrite=True))
    assert {p.name for p in tmp_path.iterdir()} == {"study"}
    _, kept = finished(tmp_path, "ours", overwrite=False)
    assert {p.name: p.read_text() for p in kept.iterdir()} == files
    with pytest.raises(Refused):
        Folder(tmp_path / "..", tmp_path.name, {}).claim(True)


def test_an_empty_folder_is_replaced(tmp_path):
    (tmp_path / "study").mkdir()
    assert finished(tmp_path, "ours", overwrite=True)[1] is None
    assert contents(tmp_path) == {"study/table.csv": "ours"}


@pytest.mark.parametrize("kind", ["file", "link", "dangling link"])
@pytest.mark.parametrize("name", ["study", "study.partial"])
def test_a_link_or_file_of_that_name_is_found_before_the_work(tmp_path, name, kind):
    out = tmp_path / "out"
    out.mkdir()
    if kind == "file":
        (out / name).write_text("mine")
    else:
        if kind == "link":
            (tmp_path / "target").mkdir()
        (out / name).symlink_to(tmp_path / "target")
    with pytest.raises(Refused, match=f"{name}: is a .*move it or choose another --out"):
        Experiment("study", Options(out=out))
    assert [p.name for p in out.iterdir()] == [name]


def test_out_that_is_a_file_or_cannot_be_made_is_a_message_with_its_path(tmp_path, capsys):
    (tmp_path / "out").write_text("mine")
    for out in (tmp_path / "out", tmp_path / "out" / "deeper", Path("/proc/none")):
        assert cli.run(["study", "gains", "--quick", "--out", str(out)]) == 2
        assert str(out) in capsys.readouterr().err


FULL = """
import resource, sys
from pathlib import Path
import numpy as np, pandas as pd, xarray as xr
from matplotlib.figure import Figure
from ewif_jax.study.shared.experiment import Experiment, Options
from ewif_jax.study.shared.refusal import Refused

out = Path(sys.argv[1])
with Experiment("s", Options(out=out)) as experiment:
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, resource.RLIM_INFINITY))
    for name, save in {
        "a.csv": lambda: experiment.csv("a", pd.DataFrame({"x": np.arange(5000)})),
        "a.nc": lambda: experiment.arrays("a", xr.Dataset({"x": ("t", np.arange(5000.0))})),
        "a.png": lambda: experiment.figure("a", Figure()),
        "piece-a.npz": lambda: experiment.piece("a", lambda: {"a": np.arange(5000)}),
    }.items():
        try:
            save()
        except OSError as error:
            assert error.filename == str(experiment.folder.partial / name), error
            print("message", error.strerror)
    assert not any(experiment.folder.partial.iterdir())
try:
    Experiment("t", Options(out=out))
except OSError as error:
    print("before", error)
print(sorted(path.name for path in out.iterdir()))
"""


def test_a_full_disk_is_a_message_with_the_path(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("message File too large") == 4
    assert f"before [Errno {errno.EFBIG}] File too large: '{tmp_path}/t.partial/" in done.stdout
    assert done.stdout.endswith("[]\n")


def test_arrays_are_read_back(tmp_path):
    dataset = xr.Dataset({"x": ("t", np.arange(5000.0), {"units": "m"})}, {"t": np.arange(5000)})
    with Experiment("study", Options(out=tmp_path)) as experiment:
        experiment.arrays("a", dataset)
        experiment.csv("b", pd.DataFrame({"x": [1]}))
        experiment.finish()
    with xr.open_dataset(tmp_path / "study" / "a.nc", engine="h5netcdf") as stored:
        xr.testing.assert_equal(stored, dataset)
        assert (stored["x"].attrs["units"], stored.attrs["study"]) == ("m", "study")
    files = json.loads((tmp_path / "study" / "about.json").read_text())["files"]
    assert set(files) == {"a.nc", "b.csv"}


def test_a_signal_says_what_happened_and_leaves_what_is_finished(tmp_path):
    command = [sys.executable, "-m", "ewif_jax", "study", "sine", "--quick", "--out", str(tmp_path)]
    piped = {"stderr": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **piped) as running:
        partial = tmp_path / "sine.partial"
        until = time.monotonic() + 60
        while not list(partial.glob("*.lock")) and time.monotonic() < until:
            time.sleep(0.05)
        time.sleep(0.5)
        refused = cli.run(command[3:])
        running.send_signal(signal.SIGTERM)
        _, said = running.communicate(timeout=60)
    assert refused == 2
    assert said == "ewif-jax: stopped by SIGTERM; the same command resumes what is finished\n"
    assert running.returncode == 143
    assert not (tmp_path / "sine").exists()
