"""Regression of one Gaussian on another, against NumPy, where it is singular too."""

import jax
import numpy as np
import pytest

from ewif_jax.kernels import symmetric

RNG = np.random.default_rng(0)


@jax.jit
def regress(cov, cross):
    return symmetric.regress(symmetric.pack(cov), cross)


def random_cov(n, rank, runs=7):
    root = RNG.normal(size=(runs, n, rank))
    return root @ np.swapaxes(root, 1, 2)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 5), (2, 2), (3, 1), (4, 5), (6, 2)])
def test_weights_and_what_they_explain(n, m):
    cov, cross = random_cov(n, n + 2), RNG.normal(size=(7, m, n))
    weights, explained = jax.jit(jax.vmap(regress))(cov, cross)
    wanted = cross @ np.linalg.inv(cov)
    np.testing.assert_allclose(weights, wanted, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(explained, wanted @ np.swapaxes(cross, 1, 2), rtol=1e-9, atol=1e-9)
    alone = jax.jit(regress)(cov[0], cross[0])
    np.testing.assert_allclose(alone[0], weights[0], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(alone[1], explained[0], rtol=1e-12, atol=1e-12)


def test_one_covariance_may_be_shared():
    cov, cross = random_cov(4, 6)[0], RNG.normal(size=(7, 2, 4))
    weights, explained = jax.jit(jax.vmap(regress, (None, 0)))(cov, cross)
    wanted = cross @ np.linalg.inv(cov)
    np.testing.assert_allclose(weights, wanted, rtol=1e-10)
    np.testing.assert_allclose(explained, wanted @ np.swapaxes(cross, 1, 2), rtol=1e-10)


@pytest.mark.parametrize("rank", [0, 1, 3])
def test_a_singular_covariance_explains_what_it_can(rank):
    """With the cross covariance in its range, weights times it is the cross covariance."""
    cov = random_cov(5, rank)
    cross = RNG.normal(size=(7, 2, 5)) @ cov
    weights, explained = jax.jit(jax.vmap(regress))(cov, cross)
    np.testing.assert_allclose(weights @ cov, cross, atol=1e-9)
    wanted = cross @ np.linalg.pinv(cov, rcond=1e-10) @ np.swapaxes(cross, 1, 2)
    np.testing.assert_allclose(explained, wanted, atol=1e-9)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives(mode):
    cov, cross = random_cov(4, 6)[0], RNG.normal(size=(2, 4))
    turn = RNG.normal(size=(4, 4))
    turn = turn + turn.T

    def at(s):
        return regress(cov + s * turn, cross + s)

    step = 1e-6
    slopes = jax.jit(mode(at))(0.0)
    for got, up, down in zip(slopes, at(step), at(-step), strict=True):
        np.testing.assert_allclose(got, (up - down) / (2 * step), rtol=1e-6, atol=1e-6)
