"""Under the true model (3) the EWIF's P is not the covariance of its error: that is the sandwich
P [sum W^4 A' H' R^-1 H A] P (ERRATA 5)."""

import jax
import numpy as np
from oracles.wls import ewif_weight, true_cov

import ewif_jax as ej
from ewif_jax.models import position_sensor, random_walk
from laws.cases import case, close, model

FILTER = ej.ewif(model(), lambda p: p["tau"])


def error_cov(world, lag, stream):
    """L R L' of the filter's own linear map from the values to the last estimate."""
    times = world.times - lag

    def last(values):
        trace = ej.run(
            FILTER,
            world.params,
            stream._replace(value=values),
            prior=None,
            t0=0.0,
            times=times,
        )
        return trace.mean[-1], trace.cov[-1]

    gain, cov = jax.jit(jax.jacfwd(last, has_aux=True))(stream.value)
    R = world.params["R"][world.sensors]
    return np.einsum("iks,kst,jkt->ij", gain, R, gain), cov


def test_the_error_covariance_is_the_sandwich():
    world = case(11, 3)
    expected = true_cov(
        world.times[-1],
        A=world.back()["A"],
        weight=ewif_weight(world.params["tau"]),
        **{k: v for k, v in world.data().items() if k != "values"},
    )
    actual, reported = error_cov(world, 0.0, world.stream())
    close(actual, expected)
    assert np.linalg.eigvalsh(reported - actual).min() > 0, "P is conservative without a lag"


def test_with_a_long_lag_the_reported_covariance_is_too_small():
    actual, reported = error_cov(case(11, 3), 3.0, case(11, 3).stream())
    assert np.linalg.eigvalsh(reported - actual).max() < 0


def test_static_scalar():
    """rho = exp(-dt / tau): P = R (1 - rho), the error variance is R (1 - rho) / (1 + rho)."""
    r, tau, dt, steps = 2.0, 0.7, 0.1, 400
    filt = ej.ewif(random_walk(sensors=position_sensor(r)), tau)
    rng = np.random.default_rng(0)
    z = np.sqrt(r) * rng.normal(size=(400, steps))
    stream = ej.stream(dt * np.arange(steps), np.zeros(steps))

    def last(values):
        trace = ej.run(filt, None, stream._replace(value=values[:, None]), prior=None, t0=0.0)
        return trace.mean[-1, 0], trace.cov[-1, 0, 0]

    rho = np.exp(-dt / tau)
    gain, variance = jax.jit(jax.jacrev(last, has_aux=True))(stream.value[:, 0])
    close(variance, r * (1 - rho))
    close(r * np.sum(np.asarray(gain) ** 2), r * (1 - rho) / (1 + rho))
    errors = z @ np.asarray(gain)
    sampled = np.mean(errors**2)
    expected = r * (1 - rho) / (1 + rho)
    assert abs(sampled - expected) < 4 * expected * np.sqrt(2 / 400)
