"""Equivalent decay times and process noises: the plane is two lines, and no answer is no number."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

SETTING = {"dt": 0.5, "steps": 60}


def model(dims, q=0.3):
    sensor = ej.models.position_sensor(2.0, dims=dims)
    return ej.models.random_walk(sensors=sensor, q=q, dims=dims)


def test_a_decay_time_in_the_plane_is_that_on_a_line():
    """For a random walk it is -dt / ln(1 - k), k the steady gain."""
    ratio = 0.3 * 0.5 / 2.0
    gain = (-ratio + np.sqrt(ratio**2 + 4 * ratio)) / 2
    wanted = -0.5 / np.log1p(-gain)
    found = ej.equivalent_tau(model(2), m=2, dt=0.5, steps=200)
    np.testing.assert_allclose(found, wanted, rtol=1e-4)


def test_process_noise_in_the_plane_is_that_on_a_line():
    found = [
        ej.equivalent_process_noise(
            model(dims, lambda p: p), 2.0, m=dims, params_of=lambda q: q, **SETTING
        )
        for dims in (1, 2)
    ]
    np.testing.assert_allclose(found[1], found[0], rtol=1e-3)


def test_where_no_tau_has_the_wanted_error_the_nearest_is_named():
    """A steady value and no process noise: no forgetting is as good, the longest tau is nearest."""
    time = np.arange(1.0, 31)
    case = ej.analysis.Case(ej.stream(time, np.zeros(30)), np.zeros((30, 1)), 2.0, 0.0)
    still = ej.models.random_walk(sensors=ej.models.position_sensor(2.0), q=0.0)
    with pytest.raises(ValueError, match=r"case: expected a value from 0\.1 to 5 .* nearest is 5"):
        ej.equivalent_tau(still, dt=1.0, steps=30, case=case, bounds=(0.1, 5.0))


def test_a_search_without_a_finite_gain_names_the_bounds():
    unseen = ej.linear_model(
        F=lambda p, t0, t1: jnp.eye(2), H=np.eye(1, 2), R=np.eye(1),
        Q=lambda p, t0, t1: jnp.eye(2),
    )  # fmt: skip
    with pytest.raises(ValueError, match="bounds: expected an interval in which the filter"):
        ej.equivalent_tau(unseen, dt=1.0, steps=5)


def test_the_band_of_nees_is_right_in_float32():
    with jax.enable_x64(False):
        low, high = ej.analysis.chi2_band(6, 100_000)
    # The normal limit of a mean of chi-squares: 6 -+ 1.96 sqrt(12 / N).
    np.testing.assert_allclose(
        [low, high], 6 + 1.959964 * np.sqrt(2 * 6 / 1e5) * np.array([-1, 1]), rtol=1e-5
    )
