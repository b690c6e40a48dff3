"""The study of two bearing sensors, and what it shares with that of the turn."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import xarray as xr

import ewif_jax as ej
from ewif_jax.scenarios import two_bearings, two_bearings_model
from ewif_jax.study import two_bearings_runs as runs_of
from ewif_jax.study.claims import claim, ratio, share
from ewif_jax.study.cli import run
from ewif_jax.study.experiment import Measured
from ewif_jax.study.one_by_one import over_cores

FIGURES = {f"delay_{d}s_{kind}.png" for d in (0, 5, 10) for kind in ("tracks", "errors")}
TABLES = {"two_bearings.csv", "claims.csv", "storage.csv"}


def light(particles=10):
    """Every name of the study, with filters that compile fast."""
    del particles
    plain = runs_of.Method(ej.extended(two_bearings_model()), "validity")
    return dict.fromkeys(METHODS, plain)


METHODS = tuple(runs_of.methods(10))


def test_study_runs_end_to_end(tmp_path, monkeypatch):
    monkeypatch.setattr(runs_of, "methods", light)
    assert run(["study", "two-bearings", "--quick", "--runs", "2", "--out", str(tmp_path)]) == 0
    folder = tmp_path / "two-bearings"
    found = {path.name for path in folder.iterdir()}
    assert found == FIGURES | TABLES | {"about.json", "delays.png", "two_bearings.nc"}
    with xr.open_dataset(folder / "two_bearings.nc", engine="h5netcdf") as stored:
        assert stored["error"].dims == ("estimator", "delay", "run", "arrival", "axis")
        assert np.isfinite(stored["rmse_of_run"]).all()
        assert stored["arrival_time"].attrs["units"] == "s"
        assert float(stored["arrival_time"].max()) <= 100.0
        padded = np.isnan(stored["arrival_time"]).sum("arrival")
        np.testing.assert_array_equal(padded, [0, 2, 4])
    table = pd.read_csv(folder / "two_bearings.csv")
    assert len(table) == 3 * (len(METHODS) + 2)
    assert set(pd.read_csv(folder / "claims.csv")["holds"]) <= {"yes", "no", "not beyond noise"}


def test_padding_the_shorter_delays_changes_nothing():
    key = jax.random.key(3)
    world = runs_of.simulated(key, 2)
    method = runs_of.methods(10)[runs_of.EKF]
    found = runs_of.followed(method, world, jax.random.key(0))
    scenario = two_bearings(10.0)
    one = scenario.simulate(jax.random.split(key, 2)[1])
    trace = ej.run(
        method.estimator, None, one.measurements, prior=scenario.prior, t0=0.0, times=one.times,
        clock="arrival",
    )  # fmt: skip
    steps, error = one.truth.shape[0], found["error"][2, 1]
    np.testing.assert_allclose(error[:steps], trace.mean[:, :2] - one.truth, atol=1e-9)
    assert np.isnan(error[steps:]).all()
    np.testing.assert_array_equal(world.times[2, :steps], one.times)


def test_one_after_the_other_is_a_loop():
    program = over_cores(lambda x, key: {"sum": jnp.cumsum(x), "draw": jax.random.normal(key)})
    x, keys = np.arange(15.0).reshape(5, 3), jax.random.split(jax.random.key(0), 5)
    found = program(x, keys)
    np.testing.assert_array_equal(found["sum"], np.cumsum(x, axis=1))
    np.testing.assert_allclose(found["draw"], [jax.random.normal(key) for key in keys])


TWO = """
import jax
import numpy as np
from ewif_jax.study.one_by_one import over_cores
assert len(jax.local_devices()) == 2
keys = jax.random.split(jax.random.key(0), 5)
found = over_cores(lambda x, key: 2 * x + 0 * jax.random.normal(key))(np.arange(5.0), keys)
assert (found == 2 * np.arange(5.0)).all()
print("same")
"""


def test_runs_are_shared_by_the_devices():
    """Five runs on two devices: the odd one out is padded."""
    flags = {**os.environ, "XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", TWO], capture_output=True, text=True, env=flags,
        check=False,
    )  # fmt: skip
    assert done.stdout == "same\n", done.stderr


def test_standard_error_of_a_ratio_is_its_scatter():
    rng = np.random.default_rng(0)
    common = rng.chisquare(4, (4000, 200))
    a, b = 2 * common + rng.chisquare(2, common.shape), common + rng.chisquare(2, common.shape)
    found = [ratio(x, y) for x, y in zip(a, b, strict=True)]
    values = np.asarray([one.value for one in found])
    errors = np.asarray([one.error for one in found])
    assert values.mean() == pytest.approx(np.sqrt(10 / 6), rel=2e-3)
    assert errors.mean() == pytest.approx(values.std(), rel=0.05)


def test_shares_and_verdicts():
    assert share(np.arange(10) < 4) == pytest.approx((0.4, np.sqrt(0.024)))
    assert share(np.zeros(10, bool)) == pytest.approx((0.0, np.sqrt(0.05 * 0.95 / 10)))
    for value, holds in ((1.2, "yes"), (1.03, "not beyond noise"), (0.8, "no")):
        assert claim("c", "p", Measured(value, 0.05), above=1)["holds"] == holds
        assert claim("c", "p", Measured(-value, 0.05), below=-1)["holds"] == holds
