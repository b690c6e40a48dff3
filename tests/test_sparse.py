"""Products that leave out known zeros are the dense products, and models know their zeros."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.fast.small import matmul, matvec
from ewif_jax.fast.sparse import Matrix, pattern, with_zeros
from ewif_jax.kernels import symmetric

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
    cov, x = random_cov(RNG), RNG.normal(size=(RUNS, N))

    def all_of(a, cov, x):
        packed = symmetric.pack(cov)
        moved = symmetric.congruence(Matrix(a, where), packed)
        return (
            symmetric.unpack(moved),
            symmetric.rows(Matrix(a[:2], where[:2]), packed),
            matvec(Matrix(a, where), x),
            matmul(Matrix(a, where), cov),
            matmul(cov, Matrix(a, where).T),
        )

    found = jax.jit(jax.vmap(all_of, (0 if per_run else None, 0, 0)))(a, cov, x)
    turned = np.swapaxes(a, -1, -2)
    wanted = (
        a @ cov @ turned,
        a[..., :2, :] @ cov,
        (a @ x[..., None])[..., 0],
        a @ cov,
        cov @ turned,
    )
    one = jax.jit(all_of)(a[0] if per_run else a, cov[0], x[0])
    for got, alone, exact in zip(found, one, wanted, strict=True):
        np.testing.assert_allclose(got, exact, atol=1e-12)
        np.testing.assert_allclose(alone, exact[0], atol=1e-12)


def test_a_matrix_is_its_values_elsewhere():
    flags = PATTERNS["two chains"]
    values = jnp.asarray(RNG.normal(size=(N, N)) * flags)
    a = with_zeros(values, pattern(flags))
    assert with_zeros(values, None) is values
    assert isinstance(a, Matrix)
    assert a.shape == (N, N)
    assert a.dtype == values.dtype
    np.testing.assert_array_equal(np.asarray(a), values)
    np.testing.assert_array_equal(jnp.where(True, a, 0), values)
    np.testing.assert_array_equal(a @ values, values @ values)
    np.testing.assert_array_equal(values @ a.T, values @ values.T)
    again = jax.jit(lambda a: a)(a)  # a pytree, whose zeros are known to the program
    assert again.where == a.where


@pytest.mark.parametrize("per_run", [False, True], ids=["shared", "per_run"])
def test_gradients_are_those_of_the_dense_product(per_run):
    flags = PATTERNS["two chains"]
    a, cov = RNG.normal(size=(RUNS, N, N)) * flags, random_cov(RNG)
    a = a if per_run else a[0]

    def loss(where, a, cov):
        packed = jax.vmap(symmetric.pack)(cov)

        def moved(a, packed):
            return symmetric.congruence(with_zeros(a, where), packed)

        run = jax.vmap(moved, (0 if per_run else None, 0))
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
    F_where, H_where = model.linear.F_where, model.linear.H_where
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
    assert (model.linear.F_where, model.linear.H_where) == (None, None)


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
