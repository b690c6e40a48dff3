"""The true path of a target that its own model drives."""

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax.models import Model
from ewif_jax.types import RandomKey


def drawn_path(model: Model, key: RandomKey, first: Array, times: Array) -> Array:
    """The state (T, n) at `times` (T,), in any order, of a target that is at `first` (n,) at time 0
    and moves with the process noise of `model`, which has no parameters."""
    order = jnp.argsort(times)
    steps = jnp.diff(times[order], prepend=0.0)
    n = first.shape[0]
    shocks = jax.random.normal(key, (times.size, n))

    def move(state: Array, given: tuple[Array, Array]) -> tuple[Array, Array]:
        step, shock = given
        none = jnp.zeros_like(step)
        cov = model.process_cov(None, none, step)
        # The covariance of no time is zero, which has a root, but no Cholesky factor.
        root = jnp.linalg.cholesky(cov + jnp.where(step > 0, 0.0, 1.0) * jnp.eye(n))
        state = model.transition(None, state, none, step) + jnp.where(step > 0, root @ shock, 0.0)
        return state, state

    _, states = jax.lax.scan(move, first, (steps, shocks))
    return jnp.zeros_like(states).at[order].set(states)
