"""Constants as a model in discrete time."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.compiling import array
from ewif_jax.fast.sparse import Pattern, pattern


def one_step(F: Any) -> tuple[Any, int | None]:
    """F as a function of (params, t0, t1), and its size if it is constant."""
    if callable(F):
        return F, None
    checks.shape("F", F, ("n", "n"))
    checks.require(np.shape(F)[0] == np.shape(F)[1], "F", "a square matrix", np.shape(F))
    checks.finite("F", F)
    ahead = array(F)
    n = ahead.shape[0]
    known = np.asarray(F)
    invertible = np.linalg.matrix_rank(known) == n
    back = jnp.asarray(np.linalg.inv(known) if invertible else np.full((n, n), np.nan), ahead.dtype)

    def matrix(params: Any, t0: Array, t1: Array) -> Array:
        del params
        still = jnp.eye(n, dtype=ahead.dtype)
        return jnp.where(t1 > t0, ahead, jnp.where(t1 < t0, back, still))

    return matrix, n


def constant_input(b: Any, n: int | None) -> Any:
    """The known input as a function of (params, t0, t1)."""
    if callable(b):
        return b
    checks.shape("b", b, ("n" if n is None else n,))
    return over_one_interval(jnp.asarray(b))


def over_one_interval(value: Array) -> Any:
    """`value` over an interval, zero over none."""
    return lambda params, t0, t1: jnp.where(t0 == t1, 0, value)


def pattern_of_powers(F: Any) -> Pattern | None:
    """Where any power of a constant F, and so its inverse, may differ from zero."""
    if callable(F):
        return None
    n = np.shape(F)[0]
    return pattern(np.linalg.matrix_power((np.asarray(F) != 0) + np.eye(n), n))
