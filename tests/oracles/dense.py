"""Dense building blocks shared by the oracles: plain stacking, nothing clever."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating]
Floats = Sequence[float] | NDArray[Any]
Stack = Sequence[ArrayLike] | NDArray[Any]
"""One array per measurement: a list, or an array stacked on axis 0."""
Between = Callable[[float, float], ArrayLike]
"""A quantity of an interval. `F(t0, t1)`: from t0 to t1. `A(t_l, t)`: from t back to t_l."""


def vector(x: ArrayLike) -> Array:
    """Return `x` as a float64 vector; a scalar becomes length one."""
    return np.atleast_1d(np.asarray(x, dtype=np.float64))


def matrix(x: ArrayLike) -> Array:
    """Return `x` as a float64 matrix; a scalar becomes one by one."""
    return np.atleast_2d(np.asarray(x, dtype=np.float64))


def block_diag(blocks: Sequence[Array]) -> Array:
    """Return the block-diagonal matrix of `blocks`, which need not be square."""
    out = np.zeros((sum(b.shape[0] for b in blocks), sum(b.shape[1] for b in blocks)))
    row = column = 0
    for block in blocks:
        rows, columns = block.shape
        out[row : row + rows, column : column + columns] = block
        row, column = row + rows, column + columns
    return out


def psd_factor(cov: ArrayLike) -> Array:
    """Return L with L L' = cov for a symmetric, possibly singular, covariance."""
    values, vectors = np.linalg.eigh(matrix(cov))
    return vectors * np.sqrt(np.clip(values, 0.0, None))


def visible(
    H: Stack,
    R: Stack,
    values: Stack,
    masks: Stack | None = None,
) -> Iterator[tuple[Array, Array, Array, NDArray[np.bool_]]]:
    """Yield (H, R, value, mask) per measurement with the masked-out components removed."""
    for k, (h, r, value) in enumerate(zip(H, R, values, strict=True)):
        h, r, value = matrix(h), matrix(r), vector(value)
        seen = np.ones(value.size, bool) if masks is None else np.atleast_1d(masks[k]).astype(bool)
        yield h[seen], r[np.ix_(seen, seen)], value[seen], seen


def interval(
    t0: float, t1: float, n: int, F: Between, Q: Between, b: Between | None = None
) -> tuple[Array, Array, Array]:
    """Return (F, Q, b) of x(t1) = F x(t0) + b + noise; (I, 0, 0) where no time passes."""
    if t1 < t0:
        raise ValueError(f"time runs backwards: from {t0} to {t1}")
    if t1 == t0:
        return np.eye(n), np.zeros((n, n)), np.zeros(n)
    return matrix(F(t0, t1)), matrix(Q(t0, t1)), np.zeros(n) if b is None else vector(b(t0, t1))


def trajectory_map(F: Sequence[Array], n: int) -> Array:
    """Return T with X = T E for x_0 = e_0, x_k = F_k x_{k-1} + e_k, all states stacked in X.

    The recursion is the linear system (I - S) X = E, S having the F_k under its diagonal.
    """
    size = n * (len(F) + 1)
    S = np.zeros((size, size))
    for k, f in enumerate(F, start=1):
        S[k * n : (k + 1) * n, (k - 1) * n : k * n] = f
    return np.linalg.inv(np.eye(size) - S)
