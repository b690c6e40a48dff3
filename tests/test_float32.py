"""float32 is as good as float64 where it matters: 1e5 steps at 100 Hz, gaps that outlast every
weight, and the return of the data."""

import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.models import constant_acceleration, position_sensor

DT, TAU, R = 0.01, 0.5, 0.04
GAP = 200 * TAU
BEFORE = 500
AFTER = 1000
SETTLED = 500
"""Steps after the gap until the filters that never forget entirely have forgotten: 10 tau."""
WORLD = constant_acceleration(sensors=position_sensor(R), q=2.0)
PRIOR = ej.Gaussian(np.zeros(3), np.diag([1.0, 1.0, 4.0]))
FILTERS = {
    "ewif": ej.ewif(WORLD, TAU),
    "fading": ej.fading(WORLD, float(np.exp(DT / (2 * TAU)))),
    "fading by inflation": ej.fading(WORLD, inflation=lambda p, t0, t1: jnp.exp((t1 - t0) / TAU)),
    "fading, Q = 0": ej.fading(
        constant_acceleration(sensors=position_sensor(R)),
        inflation=lambda p, t0, t1: jnp.exp((t1 - t0) / TAU),
    ),
    "kalman": ej.kalman(WORLD),
    "square_root": ej.square_root(WORLD),
    "information": ej.information(WORLD),
}


def measured(times):
    """A moving target seen with noise."""
    rng = np.random.default_rng(0)
    return 3.0 * np.sin(0.8 * times) + 0.01 * times + np.sqrt(R) * rng.normal(size=times.size)


def stream(times, values, dtype):
    """The same numbers in either dtype: float32 rounds a stamp of 1000 s by up to 3e-5 s, which is
    an error of the data and not of the filter."""
    return ej.stream(*(x.astype(np.float32).astype(dtype) for x in (times, values)))


def scaled_error(single, double):
    """|difference of the means| in standard deviations."""
    sd = np.sqrt(np.diagonal(double.cov, axis1=-2, axis2=-1))
    return np.abs(np.asarray(single.mean) - double.mean) / sd


@pytest.mark.parametrize("name", FILTERS)
def test_a_hundred_thousand_steps(name):
    times = DT * np.arange(1, 100_001)
    single, double = (
        ej.run(FILTERS[name], None, stream(times, measured(times), dtype), prior=PRIOR, t0=0.0)
        for dtype in (np.float32, np.float64)
    )
    assert single.mean.dtype == single.cov.dtype == np.float32
    assert scaled_error(single, double).max() < 1e-3
    np.testing.assert_allclose(single.cov, double.cov, rtol=1e-3)


@pytest.fixture(scope="module")
def two_passes():
    """Times and values of 5 s of data, a gap of 200 tau, and 10 s more."""
    times = DT * np.arange(1, BEFORE + AFTER + 1)
    times[BEFORE:] += GAP
    return times, measured(times)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", FILTERS)
def test_after_a_long_gap_new_data_take_over_completely(name, dtype, two_passes):
    times, values = two_passes
    trace = ej.run(FILTERS[name], None, stream(times, values, dtype), prior=PRIOR, t0=0.0)
    forgets = name in ("ewif", "information")
    prior = None if forgets else ej.Gaussian(np.zeros(3), 1e10 * np.eye(3))
    later = stream(times[BEFORE:], values[BEFORE:], np.float64)
    fresh = ej.run(FILTERS[name], None, later, prior=prior, t0=later.time[0])
    assert np.isfinite(trace.mean[BEFORE + 2 :]).all()
    assert np.isfinite(trace.cov[BEFORE + 2 :]).all()
    new, settled = slice(BEFORE + SETTLED, None), slice(SETTLED, None)
    recovered = ej.Gaussian(trace.mean[new], trace.cov[new])
    expected = ej.Gaussian(fresh.mean[settled], fresh.cov[settled])
    assert scaled_error(recovered, expected).max() < 1e-3
    np.testing.assert_allclose(recovered.cov, expected.cov, rtol=1e-3)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", FILTERS)
def test_in_the_gap_each_reports_what_it_no_longer_knows(name, dtype, two_passes):
    """EWIF: NaN where the weights underflow; the others: a huge, finite variance."""
    times, values = two_passes
    data = stream(times[:BEFORE], values[:BEFORE], dtype)
    report = np.append(times[: BEFORE - 1], times[BEFORE])
    trace = ej.run(FILTERS[name], None, data, prior=PRIOR, t0=0.0, times=report)
    variance = np.asarray(trace.cov[-1, 0, 0])
    if name == "ewif" and dtype == np.float32:
        assert np.isnan(trace.mean[-1]).all()
        assert np.isnan(trace.cov[-1]).all()
    else:
        assert np.isfinite(trace.mean[-1]).all()
        assert 1e8 < variance < np.inf


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_gap_that_no_weight_survives(dtype, two_passes):
    """At 2000 tau the weights underflow in float64 too: NaN, then a fresh start."""
    times, values = two_passes
    times = np.where(np.arange(times.size) < BEFORE, times, times + 1800 * TAU)
    trace = ej.run(FILTERS["ewif"], None, stream(times, values, dtype), prior=PRIOR, t0=0.0)
    assert np.isfinite(trace.mean[:BEFORE]).all()
    assert np.isnan(trace.mean[BEFORE : BEFORE + 2]).all()
    assert np.isfinite(trace.mean[BEFORE + 2 :]).all()
