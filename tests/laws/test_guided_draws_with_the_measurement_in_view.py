"""The guided particle filter: optimal for a linear sensor, right for any other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from late_streams import exact, problem, stream
from oracles.joint_gaussian import log_likelihood, posterior
from particle_runs import deviation, runs

import ewif_jax as ej
from ewif_jax.models import bearing_sensor, constant_velocity

GIVEN = problem(3, 2, 2)
TIMES = np.array([0.4, 0.9, 0.9, 1.7, 2.2])
DATA = stream(GIVEN, np.random.default_rng(1), TIMES)
DATA = DATA._replace(mask=DATA.mask.at[1, 0].set(False), value=DATA.value.at[1, 0].set(0.0))
KEY = jax.random.key(0)
FUNCTIONS = GIVEN.model._replace(linear=None)
"""The same world, with a proposal by derivatives and the weights of any sensor."""


def first(stream):
    return jax.tree.map(lambda x: x[0], stream)


@pytest.mark.parametrize("model", [GIVEN.model, FUNCTIONS], ids=["matrices", "functions"])
def test_weights_do_not_depend_on_the_draw_and_are_the_optimal_ones(model):
    filtered = ej.guided(model, 8)
    state = filtered.predict(None, filtered.init(None, GIVEN.prior, 0.0, KEY), 0.4)
    other = state._replace(key=jax.random.key(1), particles=state.particles + 3.0)
    update = jax.jit(filtered.update)
    (one, info), (two, _) = (update(None, x, first(DATA)) for x in (state, other))
    assert np.abs(one.particles - two.particles).min() > 1e-6
    np.testing.assert_allclose(one.log_weights, two.log_weights, rtol=0, atol=1e-11)
    H, R = GIVEN.H[int(DATA.sensor[0])], GIVEN.R[int(DATA.sensor[0])]
    S = H @ np.asarray(model.process_cov(None, 0.0, 0.4)) @ H.T + R
    off = np.asarray(DATA.value[0])[:, None] - H @ np.asarray(state.origins)
    log = -0.5 * (off * np.linalg.solve(S, off)).sum(0) - 0.5 * np.log(np.linalg.det(2 * np.pi * S))
    mean_weight = np.log(np.mean(np.exp(log)))
    np.testing.assert_allclose(one.log_weights, log - mean_weight - np.log(8), rtol=0, atol=1e-11)
    np.testing.assert_allclose(info.log_likelihood, mean_weight, rtol=1e-11)


def last(trace):
    return trace.mean[-1], trace.cov[-1], jnp.sum(trace.info.log_likelihood)


@pytest.mark.parametrize("model", [GIVEN.model, FUNCTIONS], ids=["matrices", "functions"])
def test_it_approaches_kalman_without_visible_bias(model):
    """Two measurements at one time and a missing component included."""
    sensors = np.asarray(DATA.sensor)
    data = {
        "times": TIMES,
        "H": GIVEN.H[sensors],
        "R": GIVEN.R[sensors],
        "values": np.asarray(DATA.value),
        "masks": np.asarray(DATA.mask),
    }
    mean, cov = posterior(TIMES[-1], **GIVEN.oracle, **data)
    log_lik = log_likelihood(**GIVEN.oracle, **data)
    means, covs, log_liks = runs(ej.guided(model, 1000), DATA, GIVEN.prior, 60, of=last)
    assert deviation(means, mean) < 4
    assert deviation(covs, cov) < 4
    assert deviation(np.exp(log_liks - log_lik), 1.0) < 4
    assert np.all(means.std(0) < 0.25 * np.sqrt(np.diag(cov)))


def test_a_measurement_at_t0_guides_the_draws_from_the_prior():
    now = first(DATA)._replace(time=jnp.zeros(()))
    filtered = ej.guided(GIVEN.model, 4000)
    state, _ = jax.jit(filtered.update)(None, filtered.init(None, GIVEN.prior, 0.0, KEY), now)
    np.testing.assert_allclose(np.ptp(state.log_weights), 0, atol=1e-12)
    told = ej.run(
        ej.kalman(GIVEN.model),
        None,
        jax.tree.map(lambda x: x[None], now),
        prior=GIVEN.prior,
        t0=0.0,
    )
    mean, cov = told.mean[0], told.cov[0]
    off = (np.mean(state.particles, 1) - mean) / np.sqrt(np.diag(cov) / 4000)
    assert np.abs(off).max() < 4


PLACES = ((3.0, -2.0), (-2.0, 4.0))
BEARINGS = constant_velocity(
    sensors=[bearing_sensor(lambda p: p["r"], p) for p in PLACES], dims=2, q=lambda p: p["q"]
)
WIDE = ej.Gaussian(np.array([-1.0, 0.2, 0.4, 0.0]), np.diag([1.0, 1.0, 0.2, 0.2]))
PARAMS = {"q": jnp.asarray(0.5), "r": jnp.asarray(0.01)}
SEEN = ej.stream(
    np.array([0.5, 1.0, 1.6, 2.0]),
    np.array([[2.6], [-1.25], [2.75], [-1.1]]),
    np.array([0, 1, 0, 1]),
)


def test_curved_sensors_are_weighed_rightly():
    """As 3000 particles of the bootstrap filter say, with a tenth of them; angles wrapped."""
    expected = runs(ej.bootstrap(BEARINGS, 3000), SEEN, WIDE, 40, PARAMS, last)
    found = runs(ej.guided(BEARINGS, 300), SEEN, WIDE, 120, PARAMS, last)
    for a, b in zip(found[:2], expected[:2], strict=True):
        error = np.sqrt(a.var(0) / len(a) + b.var(0) / len(b))
        # A ratio of averages has a bias of order 1 / N beside the error.
        assert np.all(np.abs(a.mean(0) - b.mean(0)) < 4 * error + 0.02 * np.abs(b.mean(0)).max())
    scale = expected[2].max()
    a, b = (np.exp(x[2] - scale) for x in (found, expected))
    error = np.sqrt(a.var() / len(a) + b.var() / len(b))
    assert abs(a.mean() - b.mean()) < 4 * error


def test_a_precise_sensor_leaves_more_particles_that_count():
    """One hundredth of the measurement noise: the spread of the likelihood is a third or less."""
    precise = {**PARAMS, "r": jnp.asarray(1e-4)}
    spread = [
        runs(build(BEARINGS, 300), SEEN, WIDE, 60, precise, last)[2].std()
        for build in (ej.guided, ej.bootstrap)
    ]
    assert spread[0] < spread[1] / 3


def test_late_data_through_replay_and_drop_late():
    late = stream(GIVEN, np.random.default_rng(1), [0.5, 1.0, 1.5, 0.8, 1.8])
    filtered = ej.guided(GIVEN.model, 500)

    def final(trace):
        return trace.mean[-1], trace.info.status

    means, status = runs(ej.replay(filtered, 4, width=2), late, GIVEN.prior, 30, of=final)
    assert deviation(means, exact(GIVEN, late)[0][-1]) < 4
    assert (status[:, 3] == ej.Status.LATE_USED).all()
    means, status = runs(ej.drop_late(filtered), late, GIVEN.prior, 30, of=final)
    kept = jax.tree.map(lambda x: x[np.array([0, 1, 2, 4])], late)
    assert deviation(means, exact(GIVEN, kept)[0][-1]) < 4
    assert (status[:, 3] == ej.Status.TOO_LATE).all()


@pytest.mark.parametrize(
    ("dtype", "q"), [(np.float32, 0.5), pytest.param(np.float64, 0.0, marks=pytest.mark.slow)]
)
def test_gradients_are_finite(dtype, q):
    """Without process noise too, which makes it the bootstrap filter."""
    filtered = ej.guided(BEARINGS, 50)
    seen = jax.tree.map(lambda x: x.astype(dtype) if x.dtype == float else x, SEEN)
    prior = ej.Gaussian(*(x.astype(dtype) for x in WIDE))
    params = {"q": jnp.asarray(q, dtype), "r": jnp.asarray(0.01, dtype)}

    def loss(params):
        trace = ej.run(filtered, params, seen, prior=prior, t0=dtype(0), key=KEY)
        return jnp.sum(trace.mean) + jnp.sum(trace.info.log_likelihood), trace

    (_, trace), slopes = jax.jit(jax.value_and_grad(loss, has_aux=True))(params)
    assert all(np.isfinite(x) for x in slopes.values())
    assert trace.mean.dtype == dtype
    assert (trace.info.status == ej.Status.USED).all()
    if q == 0:
        other = ej.run(ej.bootstrap(BEARINGS, 50), params, seen, prior=prior, t0=dtype(0), key=KEY)
        first_two = (x.info.log_likelihood[0] for x in (trace, other))
        np.testing.assert_allclose(*first_two, rtol=1e-10)


def test_where_the_sensor_is_no_number_at_the_origin_particles_are_drawn_from_the_motion():
    """A sensor that says nothing below zero, seen from particles on both sides of it."""
    half = ej.Model(
        lambda p, x, t0, t1: x,
        lambda p, t0, t1: 0.5 * jnp.abs(t1 - t0) * jnp.ones((1, 1)),
        lambda p, x, s, t: jnp.where(x > 0, 1.5 * x + 0.2 * x**2, jnp.nan),
        lambda p, s, t: jnp.full((1, 1), 0.01),
    )
    prior = ej.Gaussian(np.zeros(1), np.eye(1))
    seen = ej.stream(np.ones(1), np.array([[0.8]]))
    found = runs(ej.guided(half, 500), seen, prior, 60, of=last)
    expected = runs(ej.bootstrap(half, 500), seen, prior, 60, of=last)
    for a, b in zip(found, expected, strict=True):
        error = np.sqrt(a.var(0) / len(a) + b.var(0) / len(b))
        assert np.all(np.abs(a.mean(0) - b.mean(0)) < 4 * error)
        assert np.all(np.isfinite(a))


def test_nothing_explains_a_value_that_is_no_number_and_a_singular_R():
    exactly = constant_velocity(sensors=bearing_sensor(lambda p: p["r"]), dims=2, q=0.5)
    for model, z in ((BEARINGS, np.nan), (BEARINGS, np.inf), (GIVEN.model, 1e200), (exactly, 0.3)):
        n = 2 if model is GIVEN.model else 4
        prior = ej.Gaussian(np.ones(n), np.eye(n))
        filtered = ej.guided(model, 10)
        state = filtered.init(PARAMS, prior, 0.0, KEY)
        size = 2 if model is GIVEN.model else 1
        value = ej.Measurement(jnp.zeros(()), jnp.full(size, z), jnp.int32(0), jnp.ones(size, bool))
        params = {**PARAMS, "r": jnp.zeros(())} if model is exactly else PARAMS
        after, info = jax.jit(filtered.update)(params, state, value)
        assert info.status == ej.Status.REJECTED
        np.testing.assert_array_equal(after.particles, state.particles)
        assert all(np.isfinite(x).all() for x in info)
