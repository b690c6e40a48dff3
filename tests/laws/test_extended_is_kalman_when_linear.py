"""The extended Kalman filter is the Kalman filter of a linear model, matrices or not."""

import numpy as np
import pytest
from oracles.kalman_loop import kalman_filter

import ewif_jax as ej
from ewif_jax.models import bearing_sensor, constant_velocity
from laws.cases import case, close, model


def functions_only():
    """The same world, told as functions: its Jacobians are found by differentiation."""
    linear = model()
    return ej.Model(linear.transition, linear.process_cov, linear.observe, linear.measurement_cov)


KALMAN = ej.kalman(model())
EXTENDED = {build: ej.extended(build()) for build in (model, functions_only)}


@pytest.mark.parametrize("build", EXTENDED)
@pytest.mark.parametrize("rank", [0, 3])
def test_a_linear_world(build, rank):
    world = case(14, 3, rank)
    options = {"prior": world.prior, "t0": 0.0}
    expected = ej.run(KALMAN, world.params, world.stream(), **options)
    actual = ej.run(EXTENDED[build], world.params, world.stream(), **options)
    for name in ("mean", "cov"):
        close(getattr(actual, name), getattr(expected, name))
    for name in ("innovation", "innovation_cov", "log_likelihood", "status"):
        close(getattr(actual.info, name), getattr(expected.info, name))


def test_one_bearing_is_the_update_linearised_by_hand():
    x = np.array([300.0, 400.0, 1.0, -2.0])
    P = np.diag([50.0, 30.0, 4.0, 4.0])
    world = constant_velocity(sensors=bearing_sensor(1e-4, (10.0, -20.0)), dims=2, q=0.2)
    z = np.arctan2(x[1] + 20.0, x[0] - 10.0) + 0.02
    trace = ej.run(ej.extended(world), None, ej.stream([0.0], [z]), prior=ej.Gaussian(x, P), t0=0.0)
    dx, dy = x[0] - 10.0, x[1] + 20.0
    H = np.array([[-dy, dx, 0.0, 0.0]]) / (dx**2 + dy**2)
    offset = z - np.arctan2(dy, dx) + H @ x
    loop = kalman_filter(
        t0=0.0,
        prior_mean=x,
        prior_cov=P,
        F=None,
        Q=None,
        times=[0.0],
        H=[H],
        R=[[[1e-4]]],
        values=[offset],
    )
    close(trace.mean[0], loop.means[0])
    close(trace.cov[0], loop.covs[0])


def test_innovations_wrap_across_the_cut():
    world = constant_velocity(sensors=bearing_sensor(1e-2), dims=2)
    prior = ej.Gaussian(np.array([-5.0, 0.01, 0.0, 0.0]), np.eye(4))
    trace = ej.run(ej.extended(world), None, ej.stream([0.0], [-np.pi + 0.01]), prior=prior, t0=0.0)
    close(trace.info.innovation[0, 0], 0.01 + np.arctan(0.01 / 5.0), 1e-6)
