"""Products that leave out known zeros are the dense products, and models know their zeros."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.fast.small import matmul, matvec
from ewif_jax.fast.sparse import pattern
from ewif_jax.kernels import symmetric
from ewif_jax.models import patterns

RUNS, N = 5, 4
RNG = np.random.default_rng(0)
PATTERNS = {
    "triangular": np.triu(np.ones((N, N))),
    "two chains": np.kron(np.triu(np.ones((2, 2))), np.eye(2)),
    "an empty row": np.diag([1.0, 0.0, 1.0, 1.0]),
    "dense": np.ones((N, N)),
}


def random_cov(rng):
    root = rng.normal(size=(RUNS, N, N))
    return root @ np.swapaxes(root, 1, 2)


@pytest.mark.parametrize("name", PATTERNS)
@pytest.mark.parametrize("per_run", [False, True], ids=["shared", "per_run"])
def test_products_are_the_dense_ones(name, per_run):
    flags = PATTERNS[name]
    where = pattern(flags)
    a = RNG.normal(size=(RUNS, N, N)) * flags
    a = a if per_run else a[0]
    cov, plus, x = random_cov(RNG), random_cov(RNG), RNG.normal(size=(RUNS, N))

    def all_of(a, cov, plus, x):
        packed = symmetric.pack(cov)
        moved = symmetric.congruence(a, packed, where)
        added = symmetric.propagated(a, packed, symmetric.pack(plus), jnp.asarray(True), where)
        return (
            symmetric.unpack(moved),
            symmetric.unpack(added),
            symmetric.rows(a[:2], packed, where[:2]),
            matvec(a, x, where),
            matmul(a, cov, where),
        )

    found = jax.jit(jax.vmap(all_of, (0 if per_run else None, 0, 0, 0)))(a, cov, plus, x)
    moved = a @ cov @ np.swapaxes(a, -1, -2)
    wanted = moved, moved + plus, a[..., :2, :] @ cov, (a @ x[..., None])[..., 0], a @ cov
    one = jax.jit(all_of)(a[0] if per_run else a, cov[0], plus[0], x[0])
    for got, alone, exact in zip(found, one, wanted, strict=True):
        np.testing.assert_allclose(got, exact, atol=1e-12)
        np.testing.assert_allclose(alone, exact[0], atol=1e-12)


def test_what_is_not_known_is_not_a_number():
    packed = symmetric.pack(jnp.eye(N))
    moved = partial(symmetric.propagated, jnp.eye(N), packed, packed)
    assert np.isnan(moved(jnp.asarray(False))).all()
    np.testing.assert_array_equal(moved(jnp.asarray(True)), 2 * packed)


@pytest.mark.parametrize("per_run", [False, True], ids=["shared", "per_run"])
def test_gradients_are_those_of_the_dense_product(per_run):
    flags = PATTERNS["two chains"]
    a, cov = RNG.normal(size=(RUNS, N, N)) * flags, random_cov(RNG)
    a = a if per_run else a[0]

    def loss(where, a, cov):
        packed = jax.vmap(symmetric.pack)(cov)
        run = jax.vmap(partial(symmetric.congruence, where=where), (0 if per_run else None, 0))
        return jnp.sum(jnp.sin(run(a, packed)))

    for derivative in (jax.jacrev, jax.jacfwd):
        slope = jax.jit(derivative(loss, (1, 2)), static_argnums=0)
        sparse, dense = (slope(where, a, cov) for where in (pattern(flags), None))
        np.testing.assert_allclose(sparse[0], np.where(flags, dense[0], 0), atol=1e-12)
        np.testing.assert_allclose(sparse[1], dense[1], atol=1e-12)


SENSOR = ej.models.position_sensor(1.0, dims=2)
OTHER = ej.models.position_sensor(2.0, dims=2)
MODELS = {
    "random walk": ej.models.random_walk(sensors=SENSOR, q=1.0, dims=2),
    "velocity": ej.models.constant_velocity(sensors=[SENSOR, OTHER], q=1.0, dims=2),
    "acceleration": ej.models.constant_acceleration(sensors=SENSOR, q=1.0, dims=2),
    "constants": ej.linear_model(
        np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.3, 0.0, 0.9]]),
        np.array([[[1.0, 0, 0]], [[0, 0, 2.0]]]),
        np.eye(1),
        dt=0.1,
    ),
}


@pytest.mark.parametrize("name", MODELS)
def test_no_model_hides_an_element(name):
    """F in both directions of time and H of every sensor are zero wherever the pattern says so."""
    model = MODELS[name]
    F_where, H_where = patterns(model)
    assert F_where is not None
    assert H_where is not None
    for t1 in (-1.3, 0.0, 0.7):
        F = np.asarray(model.linear.F(None, jnp.asarray(0.0), jnp.asarray(t1)))
        assert np.abs(F[~np.asarray(F_where)]).max(initial=0) < 1e-15
    for sensor in range(model.sensors):
        H = np.asarray(model.linear.H(None, jnp.asarray(sensor), jnp.asarray(0.0)))
        assert not H[~np.asarray(H_where)].any()


def test_of_a_function_nothing_is_known():
    model = ej.linear_model(lambda p, t0, t1: jnp.eye(2), lambda p, s, t: jnp.eye(2), np.eye(2))
    assert patterns(model) == (None, None)


def test_a_complete_stream_need_not_say_so():
    """A mask known to be all True compiles to another program, with the same numbers."""
    model = MODELS["velocity"]
    steps = 6
    batch = ej.Measurement(
        np.cumsum(RNG.uniform(0.1, 1, (RUNS, steps)), 1)[:, [0, 2, 1, 3, 5, 4]],
        RNG.normal(size=(RUNS, steps, 2)),
        np.arange(steps) % 2,
        np.ones((steps, 2), bool),
    )
    prior = ej.Gaussian(np.zeros(4), np.eye(4))
    for estimator in (ej.kalman(model), ej.ewif(model, 2.0), ej.al1(model, 3)):

        def means(mask, estimator=estimator):
            stream = batch._replace(mask=mask)
            return ej.run_batch(estimator, None, stream, prior=prior, t0=0.0).mean

        known, traced = means(batch.mask), jax.jit(means)(batch.mask)
        np.testing.assert_allclose(known, traced, rtol=1e-12, atol=1e-12)
