"""Symmetric matrices stored as their upper triangle, row by row: n (n + 1) / 2 numbers.

What is stored this way is symmetric by construction, and its propagation is one matrix product.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax.kernels.small import matmul


def order(packed: Array) -> int:
    """n of a packed symmetric matrix."""
    return (int(np.sqrt(8 * packed.shape[0] + 1)) - 1) // 2


def pack(full: Array) -> Array:
    """The upper triangle (n (n + 1) / 2,) of a symmetric matrix (n, n)."""
    return jnp.concatenate([full[i, i:] for i in range(full.shape[0])])


def unpack(packed: Array) -> Array:
    """The symmetric matrix (n, n) of its packed upper triangle."""
    n = order(packed)
    rows, cols = np.triu_indices(n)
    index = np.zeros((n, n), int)
    index[rows, cols] = index[cols, rows] = np.arange(rows.size)
    return jnp.stack([packed[k] for k in index.ravel()]).reshape(n, n)


def congruence(a: Array, packed: Array) -> Array:
    """a P a' for a square matrix a and a packed P, packed: one product with a's second power."""
    n = a.shape[0]
    rows, cols = np.triu_indices(n)
    twice = np.asarray(rows != cols, a.dtype)[None, :]
    left, right = a[rows], a[cols]
    power = left[:, rows] * right[:, cols] + twice * left[:, cols] * right[:, rows]
    return matmul(power, packed[:, None])[:, 0]
