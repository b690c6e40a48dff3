"""Shulami & Sigalov, IV-A.2: constant acceleration with W = 1 in a window is Savitzky-Golay."""

import numpy as np
import pytest
from scipy.signal import savgol_coeffs, savgol_filter

import ewif_jax as ej
from ewif_jax.models import constant_acceleration, position_sensor

DT, LENGTH = 0.1, 11
MODEL = constant_acceleration(sensors=position_sensor(0.3))
TIMES = DT * np.arange(40)
WINDOWED = ej.limited_memory(MODEL, (LENGTH - 0.5) * DT, LENGTH)


@pytest.fixture(scope="module")
def values():
    rng = np.random.default_rng(0)
    return np.sin(2.0 * TIMES) + 0.3 * rng.normal(size=TIMES.size)


def windowed(values, times=None):
    return ej.run(WINDOWED, None, ej.stream(TIMES, values), prior=None, t0=0.0, times=times)


@pytest.mark.parametrize("deriv", [0, 1, 2])
def test_the_newest_sample_of_the_window(values, deriv):
    coefficients = savgol_coeffs(LENGTH, 2, deriv=deriv, delta=DT, pos=LENGTH - 1, use="dot")
    expected = np.lib.stride_tricks.sliding_window_view(values, LENGTH) @ coefficients
    actual = windowed(values).mean[LENGTH - 1 :, deriv]
    np.testing.assert_allclose(actual, expected, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("deriv", [0, 1, 2])
def test_the_middle_of_the_window(values, deriv):
    """The batch estimate in the middle of the last window is scipy's symmetric filter."""
    half = LENGTH // 2
    expected = savgol_filter(values, LENGTH, 2, deriv=deriv, delta=DT)[half:-half]
    actual = ej.batch_wls(
        MODEL,
        None,
        ej.stream(TIMES, values),
        TIMES[half:-half],
        weight=lambda p, t_l, t_k: 1.0 * (abs(t_l - t_k) < (half + 0.5) * DT),
    ).mean[:, deriv]
    np.testing.assert_allclose(actual, expected, rtol=1e-7, atol=1e-8)


def test_equal_weights_over_everything_are_the_polynomial_fit(values):
    """`ewif` with W = 1: the whole record, its newest sample."""
    filt = ej.ewif(MODEL, weight=lambda p, t_l, t_k: 1.0)
    trace = ej.run(filt, None, ej.stream(TIMES, values), prior=None, t0=0.0)
    fit = np.polynomial.Polynomial.fit(TIMES - TIMES[-1], values, 2).convert().coef
    np.testing.assert_allclose(trace.mean[-1], fit * [1.0, 1.0, 2.0], rtol=1e-8)
