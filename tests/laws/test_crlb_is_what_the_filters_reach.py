"""The Cramer-Rao bound is the covariance of the efficient filters, and an inverse Fisher matrix."""

import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

MODEL = ej.models.constant_velocity(sensors=ej.models.position_sensor(0.7), q=0.0)
STREAM = ej.stream([0.3, 1.0, 1.4, 0.8, 2.0], np.arange(5.0))
PRIOR = ej.Gaussian(np.array([0.5, -1.0]), np.diag([4.0, 2.0]))


def test_without_weight_it_is_kalman_without_process_noise():
    trace = ej.run(ej.replay(ej.kalman(MODEL), 4), None, STREAM, prior=PRIOR, t0=2.0 - 2.0)
    F = np.array([[1.0, 2.0], [0.0, 1.0]])
    information = np.linalg.inv(F @ PRIOR.cov @ F.T)
    bound = ej.crlb(MODEL, None, STREAM, state=np.zeros(2), time=2.0, information=information)
    np.testing.assert_allclose(bound, trace.cov[-1], rtol=1e-10)


def test_with_its_weight_it_is_what_ewif_reports():
    tau = 1.3
    trace = ej.run(ej.ewif(MODEL, tau), None, STREAM, prior=None, t0=0.0)

    def weight(params, measured, at):
        return jnp.exp((measured - at) / (2 * tau))

    bound = ej.crlb(MODEL, None, STREAM, state=np.zeros(2), time=2.0, weight=weight)
    np.testing.assert_allclose(bound, trace.cov[-1], rtol=1e-10)


def test_bearings_against_a_fisher_matrix_by_differences():
    sensors = [ej.models.bearing_sensor(0.01, p) for p in ((-3.0, 0.0), (4.0, 1.0))]
    model = ej.models.constant_velocity(sensors=sensors, q=0.0, dims=2)
    stream = ej.stream([0.0, 0.5, 1.5, 2.5], np.zeros(4), sensor=np.array([0, 1, 0, 1]))
    x = np.array([1.0, 5.0, 0.4, -0.2])

    def bearing(x, t, place):
        return np.arctan2(x[1] + t * x[3] - place[1], x[0] + t * x[2] - place[0])

    total = np.zeros((4, 4))
    for t, s in zip([0.0, 0.5, 1.5, 2.5], [0, 1, 0, 1], strict=True):
        place = ((-3.0, 0.0), (4.0, 1.0))[s]
        slope = [
            (bearing(x + d, t, place) - bearing(x - d, t, place)) / 2e-5 for d in 1e-5 * np.eye(4)
        ]
        total += np.outer(slope, slope) / 0.01
    bound = ej.crlb(model, None, stream, state=x, time=0.0)
    np.testing.assert_allclose(bound, np.linalg.inv(total), rtol=1e-4)


def test_what_is_not_determined_is_nan():
    one = ej.stream([0.0], np.zeros(1))
    assert np.all(np.isnan(ej.crlb(MODEL, None, one, state=np.zeros(2), time=0.0)))


def test_a_state_of_another_shape_is_refused():
    with pytest.raises(ValueError, match="state: expected shape"):
        ej.crlb(MODEL, None, STREAM, state=np.zeros((2, 2)), time=0.0)
