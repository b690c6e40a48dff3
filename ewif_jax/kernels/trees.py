"""Whole pytrees of arrays at once."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax.types import PyTree


def choose(condition: Array, yes: PyTree, no: PyTree) -> Any:
    """`yes` where the scalar `condition` holds, else `no`, for whole pytrees."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def copies(tree: PyTree, count: int) -> Any:
    """`tree` so many times over, along a new leading axis of every leaf."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *jnp.shape(x))), tree)
