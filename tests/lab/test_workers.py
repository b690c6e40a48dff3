"""Whoever computes a unit of work, it has the same bits."""

import multiprocessing
import os
import signal
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import ewif_jax as ej
from lab.test_resume import LINES, SETTING, WORLD

lab = ej.lab
DEVICES = """
import sys, numpy as np, jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)
import ewif_jax as ej
from lab.test_resume import LINES, SETTING, WORLD
assert len(jax.local_devices()) == 2
ej.lab.compare(LINES, WORLD, **SETTING).to_netcdf(sys.argv[1])
"""


@pytest.fixture(scope="module")
def whole():
    return lab.compare(LINES, WORLD, **SETTING).dataset


@pytest.mark.slow
def test_two_processes_and_what_a_dead_one_leaves(whole):
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=spawn) as executor:
        found = lab.compare(LINES, WORLD, executor=executor, **SETTING)
        assert found.dataset.equals(whole)
        executor.submit(os._exit, 1)
        with pytest.warns(RuntimeWarning, match="a worker died"):
            found = lab.compare(LINES, WORLD, executor=executor, **SETTING)
        assert found.dataset.equals(whole)


@pytest.mark.slow
def test_dask_computes_what_a_dead_worker_had_again():
    dask = pytest.importorskip("distributed")
    setting = {**SETTING, "runs": 24, "chunk": 2}
    whole = lab.compare(LINES, WORLD, **setting).dataset
    cluster = dask.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
    with cluster, dask.Client(cluster) as client:

        def kill_one(done, total):
            if done == 3:
                os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)

        executor = client.get_executor()
        found = lab.compare(LINES, WORLD, executor=executor, progress=kill_one, **setting)
    assert found.dataset.equals(whole)


@pytest.mark.slow
def test_two_devices(whole, tmp_path):
    import xarray as xr

    subprocess.run([sys.executable, "-c", DEVICES, tmp_path / "found.nc"], check=True,
                   env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
                   cwd=Path(__file__).parents[1])  # fmt: skip
    found = xr.load_dataset(tmp_path / "found.nc", engine="h5netcdf")
    for name in whole.data_vars:
        np.testing.assert_array_equal(found[name], whole[name])


HOSTS = """
import sys, jax
jax.config.update("jax_enable_x64", True)
jax.distributed.initialize(f"127.0.0.1:{sys.argv[3]}", 2, int(sys.argv[2]))
import ewif_jax as ej
from lab.test_resume import LINES, SETTING, WORLD
found = ej.lab.compare(LINES, WORLD, folder=sys.argv[1] + "/study", **SETTING)
found.to_netcdf(f"{sys.argv[1]}/{sys.argv[2]}.nc")
"""


@pytest.mark.slow
def test_two_processes_of_one_program(whole, tmp_path):
    import socket

    import xarray as xr

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    for _ in range(2):  # the second time all is there
        both = [
            subprocess.Popen(
                [sys.executable, "-c", HOSTS, tmp_path, str(k), str(port)], env=environment
            )
            for k in range(2)
        ]
        assert [process.wait(300) for process in both] == [0, 0]
        for k in range(2):
            found = xr.load_dataset(tmp_path / f"{k}.nc", engine="h5netcdf")
            for name in whole.data_vars:
                np.testing.assert_array_equal(found[name], whole[name])
