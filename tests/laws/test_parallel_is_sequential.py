"""The EWIF cut into blocks, or as a prefix sum, is the EWIF one arrival after the other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.parallel import run_parallel
from laws.cases import case, close, model

METHODS = [("blocked", None), ("blocked", 3), ("associative", None)]


def tau(params):
    return params["tau"]


def same_trace(actual, expected, rtol):
    for name in ("time", "mean", "cov"):
        mine, theirs = getattr(actual, name), getattr(expected, name)
        np.testing.assert_array_equal(np.isnan(mine), np.isnan(theirs))
        close(np.nan_to_num(mine), np.nan_to_num(theirs), rtol)
    for mine, theirs in zip(actual.info, expected.info, strict=True):
        close(np.nan_to_num(mine).astype(float), np.nan_to_num(theirs).astype(float), rtol)
    known = np.isfinite(expected.mean[-1]).all()
    assert known
    close(actual.final_state.mean, expected.final_state.mean, rtol)
    close(actual.final_state.matrix, expected.final_state.matrix, rtol)


@pytest.mark.parametrize(("method", "block"), METHODS)
def test_late_masked_irregular_data(method, block):
    """With an input, and reported at other times than the filter's."""
    world = case(8, 2)
    order = np.array([1, 0, 2, 4, 3, 6, 5, 9, 7, 8])
    times = np.maximum.accumulate(world.times[order]) + 0.1
    arguments = {"prior": world.prior, "t0": 0.0, "times": times}
    stream = world.stream(order)
    sequential = ej.run(ej.ewif(model(), tau), world.params, stream, **arguments)
    parallel = run_parallel(
        model(), world.params, stream, tau=tau, method=method, block=block, **arguments
    )
    same_trace(parallel, sequential, rtol=1e-9)


def test_steps_of_constant_matrices():
    """A constant F is one step whatever its length, so it has to be multiplied up."""
    turn = ej.linear_model(
        F=np.array([[0.9, 0.3], [-0.3, 0.9]]), H=np.eye(1, 2), R=np.eye(1), b=np.ones(2)
    )
    data = ej.stream(np.arange(1.0, 41.0), np.sin(np.arange(40.0)))
    sequential = ej.run(ej.ewif(turn, 5.0), None, data, prior=None, t0=0.0)
    parallel = run_parallel(turn, None, data, tau=5.0, prior=None, t0=0.0)
    same_trace(parallel, sequential, rtol=1e-9)


def test_any_weight_of_the_family():
    world = case(8, 2)

    def slowing(params, measured, at):
        return ((1.0 + measured) / (1.0 + at)) ** 2

    arguments = {"prior": world.prior, "t0": 0.0}
    sequential = ej.run(ej.ewif(model(), weight=slowing), world.params, world.stream(), **arguments)
    parallel = run_parallel(model(), world.params, world.stream(), weight=slowing, **arguments)
    same_trace(parallel, sequential, rtol=1e-9)


def test_gradient():
    world = case(8, 2)
    arguments = {"prior": None, "t0": 0.0}

    def loss(trace):
        return jnp.nansum(trace.mean**2) + jnp.sum(trace.info.log_likelihood)

    def sequential(decay):
        params = {**world.params, "tau": decay}
        return loss(ej.run(ej.ewif(model(), tau), params, world.stream(), **arguments))

    def parallel(decay):
        params = {**world.params, "tau": decay}
        return loss(run_parallel(model(), params, world.stream(), tau=tau, **arguments))

    slope = (sequential(0.9 + 1e-5) - sequential(0.9 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.jit(jax.grad(parallel))(0.9), slope, rtol=1e-7)


def test_float32_is_close_far_from_zero():
    far = ej.models.constant_velocity(sensors=ej.models.position_sensor(1.0))
    time = 0.1 * np.arange(1, 301)
    value = 1e4 + 10.0 * np.sin(time) + np.random.default_rng(9).normal(size=300)
    high = ej.run(ej.ewif(far, 2.0), None, ej.stream(time, value), prior=None, t0=0.0)
    single = ej.stream(time, value.astype(np.float32))
    low = run_parallel(far, None, single, tau=2.0, prior=None, t0=0.0)
    assert low.mean.dtype == jnp.float32
    error = np.abs(low.mean - high.mean)[100:] / np.sqrt(np.diagonal(high.cov[-1]))
    assert error.max() < 0.05


def test_bad_input_is_named():
    world = case(8, 2)
    for changes, word in (({"method": "both"}, "method"), ({"block": 0}, "block"), ({}, "tau")):
        with pytest.raises(ValueError, match=word):
            run_parallel(
                model(), world.params, world.stream(), tau=tau if changes else -1.0,
                prior=None, t0=0.0, **changes,
            )  # fmt: skip
