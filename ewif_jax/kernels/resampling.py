"""Resampling: equally weighted particles in place of weighted ones, in linear time."""

from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array, lax

Resampling = Literal["systematic", "stratified"]


def effective_sample_size(log_weights: Array) -> Array:
    r""":math:`1 / \sum_i w_i^2` () of log weights (N,) of any total, between 1 and N."""
    w = jnp.exp(log_weights - lax.stop_gradient(jnp.max(log_weights)))
    return jnp.square(jnp.sum(w)) / jnp.sum(jnp.square(w))


def ancestors(key: Array, log_weights: Array, method: Resampling) -> Array:
    r"""Which particle each of N equally weighted ones is a copy of, (N,) int32, in rising order.

    Slot k goes to the particle whose share of the cumulative weight holds
    :math:`(k + u_k) / N, u_k \sim U[0, 1)`: one u for all slots ("systematic") or one for each
    ("stratified"). Particle i is copied :math:`N w_i` times on average; a particle of zero weight
    (log weight -inf) never is. No sorting and no searching: every particle marks the first slot of
    its share, and a running maximum fills the slots between.
    """
    N = log_weights.shape[0]
    # Which particle is copied is a choice of whole numbers: it has no derivative, and one through
    # the weights would be wrong.
    w = lax.stop_gradient(jnp.exp(log_weights - jnp.max(log_weights)))
    up_to = jnp.cumsum(w)
    # The begin of each share in units of slots. The sum itself normalises, so that rounding cannot
    # leave a last slot without a particle.
    share = (up_to - w) * (N / up_to[-1])
    slot = jnp.clip(share, 0, N).astype(jnp.int32)
    if method == "systematic":
        u = jax.random.uniform(key, (), w.dtype)
    else:
        u = jax.random.uniform(key, (N,), w.dtype)[jnp.minimum(slot, N - 1)]
    beyond = (u < share - slot.astype(w.dtype)).astype(jnp.int32)
    first = jnp.where(w > 0, slot + beyond, N)
    # Several small particles may begin in one slot; the last of them has it, as a search would
    # find. What begins beyond the last slot is dropped: no copy.
    marks = jnp.zeros(N, jnp.int32).at[first].max(jnp.arange(N, dtype=jnp.int32), mode="drop")
    return lax.cummax(marks)
