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
from ewif_jax.monte_carlo import Scenario, Simulation
from ewif_jax.scenarios import two_bearings, two_bearings_model
from ewif_jax.study.cli import run
from ewif_jax.study.papers.two_bearings import runs as runs_of
from ewif_jax.study.shared.claims import at_any_of, claim, quotient, ratio, share, surest
from ewif_jax.study.shared.experiment import Measured
from ewif_jax.study.shared.one_by_one import over_cores, seconds_per_run, tracker

FIGURES = {f"delay_{d}s_{kind}.png" for d in (0, 5, 10) for kind in ("tracks", "errors")}
TABLES = {"two_bearings.csv", "claims.csv", "storage.csv"}


def light(particles=10):
    """Every name of the study, with filters that compile fast."""
    del particles
    plain = runs_of.BearingsMethod(ej.extended(two_bearings_model()), "validity")
    return dict.fromkeys(METHODS, plain)


METHODS = tuple(runs_of.bearings_methods(10))


def test_study_runs_end_to_end(tmp_path, monkeypatch):
    monkeypatch.setattr(runs_of, "bearings_methods", light)
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
    claims = pd.read_csv(folder / "claims.csv")
    assert set(claims["holds"]) <= {"yes", "no", "not beyond noise"}
    assert (claims["reason"].isna() == (claims["holds"] == "yes")).all()


def test_padding_the_shorter_delays_changes_nothing():
    key = jax.random.key(3)
    world = runs_of.bearings_world(key, 2)
    method = runs_of.bearings_methods(10)[runs_of.EKF]
    found = runs_of.followed_bearings(method, world, jax.random.key(0))
    scenario = two_bearings(10.0)
    one = jax.jit(scenario.simulate)(jax.random.split(key, 2)[1])
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
from ewif_jax.study.shared.one_by_one import over_cores
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


def test_standard_error_of_a_quotient_is_its_scatter():
    rng = np.random.default_rng(1)
    a, b = 5 + 0.1 * rng.normal(size=20_000), 2 + 0.06 * rng.normal(size=20_000)
    found = quotient(Measured(5.0, 0.1), Measured(2.0, 0.06))
    assert found.value == 2.5
    assert found.error == pytest.approx((a / b).std(), rel=0.03)


def test_shares_and_verdicts():
    assert share(np.arange(10) < 4) == pytest.approx((0.4, np.sqrt(0.024)))
    assert share(np.zeros(10, bool)) == pytest.approx((0.0, np.sqrt(0.05 * 0.95 / 10)))
    for value, holds in ((1.2, "yes"), (1.03, "not beyond noise"), (0.8, "no")):
        assert claim("c", "p", Measured(value, 0.05), above=1)["holds"] == holds
        assert claim("c", "p", Measured(-value, 0.05), below=-1)["holds"] == holds
    for value, holds in ((1.0, "yes"), (1.04, "not beyond noise"), (0.9, "no"), (1.1, "no")):
        row = claim("c", "p", Measured(value, 0.01), above=0.95, below=1.05)
        assert (row["holds"], row["holds if"]) == (holds, "0.95 to 1.05")
    assert claim("c", "p", Measured(1.2, 0.05), above=1, sigmas=5)["holds"] == "not beyond noise"


def test_a_claim_that_does_not_hold_says_why():
    known, unknown = {"reason": "because"}, {}
    for value, texts in ((1.2, ("", "")), (0.8, ("because", "unexplained")),
                         (1.0, ("because", "too few runs to tell"))):  # fmt: skip
        for given, text in zip((known, unknown), texts, strict=True):
            assert claim("c", "p", Measured(value, 0.05), above=1, **given)["reason"] == text
    nothing = ratio(np.ones(1), np.ones(1))
    assert claim("c", "p", nothing, above=1)["holds"] == "not beyond noise"


def test_the_surest_of_many_seconds_is_a_chance_hit_as_seldom_as_one():
    """Two equal filters, 26 seconds of errors that last: a one-sided 2.3 % test each, or together.
    The largest ratio, with its own standard error, would hit in a fifth of the studies."""
    rng = np.random.default_rng(3)
    studies, runs, count = 400, 200, 26

    def squares():
        noise = rng.normal(size=(studies, runs, count))
        for k in range(1, count):
            noise[..., k] = 0.9 * noise[..., k - 1] + np.sqrt(0.19) * noise[..., k]
        return 1 + noise**2

    hits = np.zeros(2)
    for a, b in zip(squares(), squares(), strict=True):
        ratios = [ratio(a[:, k], b[:, k]) for k in range(count)]
        top, largest = surest(ratios), max(ratios, key=lambda one: one.value)
        hits += (
            claim("c", "p", top, above=1, sigmas=at_any_of(count))["holds"] == "yes",
            claim("c", "p", largest, above=1)["holds"] == "yes",
        )
    assert hits[0] / studies < 0.0228 + 3 * np.sqrt(0.0228 / studies)
    assert hits[1] / studies > 0.1
    assert at_any_of(1) == pytest.approx(2.0)
    one = [Measured(1.1, 0.02), Measured(1.2, 0.1), Measured(0.9, 0.0)]
    assert surest(one) == one[0]
    assert surest(one[2:]) == one[2]


def test_parts_of_a_batch_are_timed_apart():
    model, runs = ej.linear_model(np.eye(1), np.eye(1), np.eye(1), np.eye(1)), 12
    scenario = Scenario(lambda key: None, ej.Gaussian(np.zeros(1), np.eye(1)), 0.0)
    values = np.arange(runs)[:, None, None] + np.zeros((runs, 2, 1))
    data = jax.vmap(lambda value: ej.stream([1.0, 2.0], value))(values)
    track = tracker(ej.kalman(model), scenario, lambda trace, _: {"mean": trace.mean[-1, 0]})
    keys = jax.random.split(jax.random.key(0), runs)
    found = track(Simulation(data, values, None), keys)
    np.testing.assert_allclose(found["mean"], found["mean"][1] * np.arange(runs))
    times = found["core_seconds"]
    assert (times.shape, (times > 0).all()) == ((runs,), True)
    parts = times[::3]  # of 3 runs each
    np.testing.assert_array_equal(np.repeat(parts, 3), times)
    assert seconds_per_run(times) == pytest.approx((parts.mean(), parts.std(ddof=1) / 2))
    assert np.isnan(seconds_per_run(times[:3]).error)
