"""Tables of the last few entries, newest first, that stay fast under `vmap`: a batched index or
concatenation would be done one element at a time."""

import jax.numpy as jnp
from jax import Array

from ewif_jax.fast.batched import kernel, total


def pushed(new: Array, table: Array, push: Array) -> Array:
    """The table (L, ...) with `new` (...) in front and the last entry gone, where `push` ()."""
    return _pushed_kernel(new, table, push)


def picked(table: Array, here: Array) -> Array:
    """The entry (...) of the table (L, ...) where `here` (L,) is True; zeros if nowhere."""
    return _picked_kernel(table, here)


@kernel
def _pushed_kernel(new: Array, table: Array, push: Array) -> Array:
    batch = jnp.broadcast_shapes(*(x.shape[x.ndim - push.ndim :] for x in (new, table, push)))
    new, table = (jnp.broadcast_to(x, x.shape[: x.ndim - push.ndim] + batch) for x in (new, table))
    moved = jnp.concatenate([new[None], table[:-1]])
    return jnp.where(_leading_ones(push, table.ndim), moved, table)


@kernel
def _picked_kernel(table: Array, here: Array) -> Array:
    # A sum over one-hot terms instead of an index: with a batch an index becomes a gather, run by
    # run. `where` and not a product: entries that are not chosen may be infinite.
    if here.ndim == 1:
        return jnp.sum(jnp.where(here.reshape(-1, *(1,) * (table.ndim - 1)), table, 0), 0)
    return total(
        jnp.where(_leading_ones(chosen, entry.ndim), entry, 0)
        for chosen, entry in zip(here, table, strict=True)
    )


def _leading_ones(x: Array, rank: int) -> Array:
    """`x` with leading axes of length 1."""
    return x.reshape((1,) * (rank - x.ndim) + x.shape)
