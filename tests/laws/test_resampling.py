"""Resampling copies every particle as often as its weight says, and never one without weight."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ewif_jax.kernels.resampling import ancestors, effective_sample_size

SCHEMES = ("systematic", "stratified")


def weights(seed: int, count: int) -> np.ndarray:
    """Uneven log weights of no particular total; a fifth of the particles have none."""
    rng = np.random.default_rng(seed)
    log_weights = 3 * rng.normal(size=count)
    log_weights[rng.permutation(count)[: count // 5]] = -np.inf
    return log_weights


def copies(keys, log_weights, scheme):
    chosen = jax.vmap(lambda key: ancestors(key, jnp.asarray(log_weights), scheme))(keys)
    return np.stack([np.bincount(row, minlength=log_weights.size) for row in chosen])


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("seed", range(3))
def test_it_is_the_search_in_the_cumulative_weights(scheme, seed):
    log_weights = weights(seed, 200)
    key = jax.random.key(seed)
    u = jax.random.uniform(key, () if scheme == "systematic" else (200,), jnp.float64)
    share = np.cumsum(np.exp(log_weights) / np.exp(log_weights).sum())
    expected = np.searchsorted(share, (np.arange(200) + u) / 200, side="right")
    np.testing.assert_array_equal(ancestors(key, jnp.asarray(log_weights), scheme), expected)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_copies_are_unbiased_and_as_even_as_promised(scheme):
    log_weights = weights(7, 50)
    counts = copies(jax.random.split(jax.random.key(0), 4000), log_weights, scheme)
    share = 50 * np.exp(log_weights) / np.exp(log_weights).sum()
    error = np.maximum(counts.std(0), 0.02) / np.sqrt(4000)
    assert (np.abs(counts.mean(0) - share) < 4.5 * error).all()
    assert (np.abs(counts - share) < (1 if scheme == "systematic" else 2) + 1e-9).all()
    assert (counts[:, np.isinf(log_weights)] == 0).all()
    assert (counts.sum(1) == 50).all()


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("where", [0, 5000, 9999])
def test_a_single_particle_with_weight_takes_all_places(scheme, where):
    log_weights = jnp.full(10_000, -jnp.inf, jnp.float32).at[where].set(-1e5)
    chosen = ancestors(jax.random.key(1), log_weights, scheme)
    assert chosen.dtype == jnp.int32
    assert (np.asarray(chosen) == where).all()
    assert effective_sample_size(log_weights) == 1


@pytest.mark.parametrize("scheme", SCHEMES)
def test_in_float32_no_particle_without_weight_comes_back(scheme):
    """Rounding of the cumulative sum must not open gaps that weightless particles fill."""
    log_weights = jnp.asarray(weights(3, 10_000), jnp.float32)
    for seed in range(20):
        chosen = ancestors(jax.random.key(seed), log_weights, scheme)
        assert np.isfinite(log_weights[chosen]).all()
        assert (np.diff(chosen) >= 0).all()


def test_effective_sample_size_counts_equal_particles():
    log_weights = jnp.where(jnp.arange(10) < 4, 1e3, -jnp.inf)
    np.testing.assert_allclose(effective_sample_size(log_weights), 4.0)
