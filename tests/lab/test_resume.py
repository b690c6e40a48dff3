"""A comparison in a folder goes on where it was stopped, and is never mixed with anything else."""

import json
import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.lab import lock
from lab.world import KEY, WORLD, methods, simulate

lab = ej.lab
OVER = {"delay": [0.0, 1.4]}
SETTING = {"over": OVER, "runs": 10, "chunk": 4, "key": KEY}
UNITS = 6
LINES = {"EWIF": methods()["EWIF"]}


@pytest.fixture(scope="module")
def whole():
    return lab.compare(LINES, WORLD, **SETTING).dataset


class Stop(Exception):
    pass


def stop_after(count):
    def progress(done, total):
        assert total == UNITS
        if done >= count:
            raise Stop

    return progress


def files(folder):
    return sorted(path.name for path in (folder / "units").iterdir())


def test_it_goes_on_where_it_was_stopped(whole, tmp_path):
    folder = tmp_path / "study"
    for count in (2, 3):
        with pytest.raises(Stop):
            lab.compare(LINES, WORLD, folder=folder, progress=stop_after(count), **SETTING)
        assert len(files(folder)) == count
    before = {name: (folder / "units" / name).stat().st_mtime_ns for name in files(folder)}
    found = lab.compare(LINES, WORLD, folder=folder, **SETTING)
    assert found.dataset.equals(whole)
    assert all((folder / "units" / n).stat().st_mtime_ns == t for n, t in before.items())
    asked = []
    again = lab.compare(LINES, WORLD, folder=folder, progress=lambda *x: asked.append(x), **SETTING)
    assert again.dataset.equals(whole)
    assert asked == []  # nothing was left to do


@pytest.mark.parametrize("broken", [b"", b"no zip", None])
def test_what_is_not_whole_is_computed_again(broken, whole, tmp_path):
    lab.compare(LINES, WORLD, folder=tmp_path, **SETTING)
    victim = tmp_path / "units" / files(tmp_path)[3]
    data = victim.read_bytes()
    middle = len(data) // 2
    flipped = data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]
    victim.write_bytes(flipped if broken is None else broken)
    half = victim.with_name(f".{os.getpid()}.{victim.name}")
    half.write_bytes(b"half of a file")
    found = lab.compare(LINES, WORLD, folder=tmp_path, **SETTING)
    assert found.dataset.equals(whole)
    assert not half.exists()


def own_simulate(key, params):
    return simulate(key, {**params, "q": 2 * params["q"]})


OTHERS = {
    "another seed": ({"key": jax.random.key(9)}, "key: "),
    "more runs": ({"runs": 12}, "runs: 10 there, 12 here"),
    "another chunk": ({"chunk": 5}, "chunk: 4 there, 5 here"),
    "another grid": ({"over": {"delay": [0.0, 1.5]}}, "over: "),
    "another scenario": ({"scenario": WORLD._replace(simulate=own_simulate)}, "scenario: "),
    "another method": (
        {"methods": {"EWIF": methods()["EWIF"]._replace(params={"tau": 3.0})}},
        "methods: ",
    ),
}


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    folder = tmp_path_factory.mktemp("filled")
    lab.compare(LINES, WORLD, folder=folder, **SETTING)
    return folder


@pytest.mark.parametrize("case", OTHERS.values(), ids=OTHERS)
def test_other_settings_or_code_are_refused_by_name(case, filled):
    change, told = case
    before = {name: (filled / "units" / name).read_bytes() for name in files(filled)}
    given = {"methods": LINES, "scenario": WORLD, "folder": filled, **SETTING, **change}
    with pytest.raises(ValueError, match=rf"folder: expected a new folder.*\({told}"):
        lab.compare(given.pop("methods"), given.pop("scenario"), **given)
    assert before == {name: (filled / "units" / name).read_bytes() for name in files(filled)}


def test_a_folder_of_somebody_else_is_not_touched(tmp_path):
    for name, text in (("photo.jpg", "a photo"), ("about.json", '{"study": "sine"}')):
        folder = tmp_path / name
        folder.mkdir()
        (folder / name).write_text(text)
        with pytest.raises(ValueError, match="files of something else"):
            lab.compare(LINES, WORLD, folder=folder, **SETTING)
        assert [path.name for path in folder.iterdir()] == [name]
        assert (folder / name).read_text() == text
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "photo.jpg")
    for place in (link, tmp_path / "photo.jpg" / "photo.jpg"):
        with pytest.raises(ValueError, match="folder: expected a folder"):
            lab.compare(LINES, WORLD, folder=place, **SETTING)


HOLDER = """
import fcntl, os, sys, time
file = open(sys.argv[1], "w")
fcntl.flock(file, fcntl.LOCK_EX)
print(file.write("4711"), file.flush(), flush=True)
time.sleep(60)
"""


def test_two_processes_do_not_share_a_folder(tmp_path):
    command = [sys.executable, "-c", HOLDER, str(tmp_path / ".lock")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        with pytest.raises(RuntimeError, match=r"another process \(4711\)"):
            lab.compare(LINES, WORLD, folder=tmp_path, **SETTING)
        holder.kill()
    lab.compare(LINES, WORLD, folder=tmp_path, **SETTING)
    assert not [held for held in lock._held if tmp_path in held.parents]


def test_a_disk_that_is_full_or_read_only_is_found_before_the_work(tmp_path, monkeypatch):
    little = SimpleNamespace(free=100)
    monkeypatch.setattr("ewif_jax.lab.store.shutil.disk_usage", lambda _: little)
    with pytest.raises(OSError, match="are free") as caught:
        lab.compare(LINES, WORLD, folder=tmp_path / "full", **SETTING)
    assert caught.value.filename == str(tmp_path / "full")
    monkeypatch.undo()

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.write_bytes", refuse)
    with pytest.raises(OSError, match="Permission denied") as caught:
        lab.compare(LINES, WORLD, folder=tmp_path / "read-only", **SETTING)
    assert str(tmp_path / "read-only") in str(caught.value.filename)


KILLED = """
import sys, jax
jax.config.update("jax_enable_x64", True)
import ewif_jax as ej
from lab.test_resume import LINES, SETTING, WORLD
print("ready", flush=True)
ej.lab.compare(LINES, WORLD, folder=sys.argv[1], progress=True, **SETTING)
"""


@pytest.mark.slow
def test_kill_at_any_moment_loses_nothing(whole, tmp_path):
    generator = np.random.default_rng(0)
    for _ in range(20):
        command = [sys.executable, "-c", KILLED, str(tmp_path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(generator.uniform(0, 4))
            process.send_signal(signal.SIGKILL)
    found = lab.compare(LINES, WORLD, folder=tmp_path, **SETTING)
    assert found.dataset.equals(whole)
    assert json.loads((tmp_path / "about.json").read_text())["runs"] == 10
