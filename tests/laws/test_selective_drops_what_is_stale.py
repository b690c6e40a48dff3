"""The selective filter: a strict limit of the delay, and its differentiable version."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from late_streams import problem, stream
from oracles.late import selective_filter
from scipy.stats import norm

import ewif_jax as ej
from ewif_jax.oosm.al1 import al1
from ewif_jax.oosm.asd import asd
from ewif_jax.oosm.drop_late import drop_late
from ewif_jax.oosm.selective import selective

GIVEN = problem(41, 3, 2)
TIMES = np.array([0.5, 1.0, 2.0, 1.5, 1.0, 2.0, 3.0, 2.75, 0.9, 4.0, 3.0, 2.0])
DATA = stream(GIVEN, np.random.default_rng(0), TIMES)


def go(method, data=DATA, params=None):
    return ej.run(method, params, data, prior=GIVEN.prior, t0=0.0)


HARD = selective(al1(GIVEN.model, 12), lambda max_delay: max_delay)


@pytest.mark.parametrize("max_delay", [0.25, 0.5, 1.0, 2.5])
def test_the_cut_off_is_strict_and_the_clock_a_running_maximum(max_delay):
    _, used = selective_filter(lambda seen, k: seen, None, TIMES, max_delay)
    trace = go(HARD, params=max_delay)
    np.testing.assert_array_equal(trace.info.status != ej.Status.TOO_LATE, used)
    dropped = np.flatnonzero(~np.array(used))
    np.testing.assert_array_equal(trace.mean[dropped], trace.mean[dropped - 1])
    np.testing.assert_array_equal(trace.info.log_likelihood[dropped], 0)
    kept = DATA._replace(mask=DATA.mask & np.array(used)[:, None])
    np.testing.assert_allclose(trace.mean[-1], go(al1(GIVEN.model, 12), kept).mean[-1], atol=1e-12)


def test_the_two_extremes():
    method = al1(GIVEN.model, 12)
    plain, every, none = go(method), go(HARD, params=np.inf), go(HARD, params=0.0)
    np.testing.assert_array_equal(every.mean, plain.mean)
    dropped = go(ej.kalman(GIVEN.model))
    np.testing.assert_allclose(none.mean, dropped.mean, atol=1e-12)
    np.testing.assert_array_equal(none.info.status, dropped.info.status)


def test_ewif_can_be_gated_too():
    method = ej.ewif(GIVEN.model, tau=1.0)
    dropped = go(drop_late(method))
    late = np.maximum.accumulate(TIMES) > TIMES
    in_order = go(method, jax.tree.map(lambda x: x[~late], DATA))
    np.testing.assert_allclose(dropped.mean[-1], in_order.mean[-1], atol=1e-12)


gated = pytest.mark.parametrize(
    "name", ["al1", "ewif", "replay", pytest.param("asd", marks=pytest.mark.slow)]
)
"""asd is gated as al1 is"""


def build(name, model, lag=6):
    return {
        "al1": lambda: al1(model, lag),
        "asd": lambda: asd(model, lag),
        "ewif": lambda: ej.ewif(model, tau=2.0),
        "replay": lambda: ej.replay(ej.kalman(model), lag, width=2),
    }[name]()


@gated
def test_a_soft_gate_is_a_noisier_measurement(name):
    """Means and covariance: S / g. Information: R / g."""
    given = problem(42, 2, 1)
    table = jnp.asarray(given.R)
    times = np.array([1.0, 2.0, 1.5, 1.2, 2.5])
    data = stream(given, np.random.default_rng(1), times)

    def method(scale):
        def R(params, sensor, t):
            return table[sensor] + jnp.where(t == 1.5, scale, 0.0)

        return build(name, given.model._replace(measurement_cov=R), lag=3)

    options = {"prior": given.prior, "t0": 0.0}
    plain = ej.run(method(0.0), None, data, **options)
    soft = ej.run(selective(method(0.0), 0.6, softness=0.2), None, data, **options)
    g = 1 / (1 + np.exp(-(0.6 - 0.5) / 0.2))
    R = given.R[int(data.sensor[2]), 0, 0]
    spread = plain.info.innovation_cov[2, 0, 0] if name != "ewif" else R
    expected = ej.run(method((1 / g - 1) * spread), None, data, **options)
    np.testing.assert_allclose(soft.mean[2], expected.mean[2], rtol=1e-10)
    np.testing.assert_allclose(soft.cov[2], expected.cov[2], rtol=1e-10)
    # the share g of its own log likelihood, and all of what `replay` has refiltered
    in_place = [norm(0, np.sqrt(x.info.innovation_cov[2, 0, 0])) for x in (plain, expected)]
    whole, noisier = (x.logpdf(plain.info.innovation[2, 0]) for x in in_place)
    rest = expected.info.log_likelihood[2] - noisier
    np.testing.assert_allclose(soft.info.log_likelihood[2], g * whole + rest, rtol=1e-9)
    np.testing.assert_allclose(soft.mean[:2], plain.mean[:2], atol=1e-14)


@gated
def test_a_soft_gate_hardens(name):
    method = build(name, GIVEN.model)
    hard = go(selective(method, 1.1))
    soft = go(selective(method, 1.1, softness=1e-3))
    np.testing.assert_allclose(soft.mean, hard.mean, atol=1e-12)
    np.testing.assert_allclose(soft.cov, hard.cov, atol=1e-12)


@gated
def test_the_cut_off_has_a_gradient(name):
    method = build(name, GIVEN.model)
    soft = selective(method, lambda p: p[0], softness=lambda p: p[1])

    def loss(params):
        trace = go(soft, params=params)
        return jnp.sum(trace.mean**2) + jnp.sum(trace.cov) + jnp.sum(trace.info.log_likelihood)

    @jax.jit
    def both_modes(at):
        _, push = jax.linearize(loss, at)
        return jax.linear_transpose(push, at)(jnp.ones(()))[0], jax.vmap(push)(jnp.eye(2))

    at, h = jnp.array([0.9, 0.4]), 1e-5
    shifts = h * np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])
    around = np.stack(list(map(jax.jit(loss), np.asarray(at) + shifts)))
    expected = (around[::2] - around[1::2]) / (2 * h)
    for found in both_modes(at):
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_what_is_refused():
    method = al1(GIVEN.model, 2)
    with pytest.raises(ValueError, match="max_delay: expected a number >= 0"):
        selective(method, -1.0)
    with pytest.raises(ValueError, match="softness: expected a positive number"):
        selective(method, 1.0, softness=0.0)
    random = selective(ej.bootstrap(GIVEN.model, 10), 1.0, softness=0.1)
    with pytest.raises(ValueError, match="softness: expected an estimator with means"):
        ej.run(random, None, DATA, prior=GIVEN.prior, t0=0.0, key=jax.random.key(0))
    for wrapper in (drop_late, lambda e: selective(e, 1.0)):
        with pytest.raises(ValueError, match="estimator: expected an Estimator"):
            wrapper(GIVEN.model)
