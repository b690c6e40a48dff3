"""Batch weighted least squares: Theorems 1 and 2 of Shulami & Sigalov, eqs. (4), (8), (9)."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from .dense import Array, Between, Floats, Stack, matrix, vector, visible

Weight = Callable[[float, float], float]
"""W(t_l, t_k): the square root of the weight that the information of time t_l has at t_k."""
Prior = tuple[ArrayLike, ArrayLike, float]
"""(mean, cov, time) of a Gaussian prior, weighted like a measurement of the whole state."""


def ewif_weight(tau: float) -> Weight:
    """Return W = exp(-(t_k - t_l) / 2 tau), eqs. (12), (25); above 1 for a newer measurement."""
    return lambda t_l, t_k: math.exp(-(t_k - t_l) / (2.0 * tau))


def symmetric_weight(tau: float) -> Weight:
    """Return W = exp(-|t_k - t_l| / 2 tau); it breaks (11c), so it has no one-pass recursion."""
    return lambda t_l, t_k: math.exp(-abs(t_k - t_l) / (2.0 * tau))


def window_weight(width: float) -> Weight:
    """Return the Savitzky-Golay kernel (5): W = 1 where |t_k - t_l| <= width, else 0."""
    return lambda t_l, t_k: 1.0 if abs(t_k - t_l) <= width else 0.0


def batch_wls(
    t: float,
    A: Between,
    offset: Between | None,
    times: Floats,
    H: Stack,
    R: Stack,
    values: Stack,
    weight: Weight,
    prior: Prior | None = None,
    masks: Stack | None = None,
) -> tuple[Array, Array]:
    """Return the minimiser (8) of the cost (4) at time `t` and the covariance (9).

    x(t_l) = A(t_l, t) x(t) + offset(t_l, t), and y_l = H_l x(t_l) + v_l, cov(v_l) = R_l. Every
    row is divided by its standard deviation and multiplied by W; the stack is solved by QR.
    """
    rows, targets, _ = _stack(t, A, offset, times, H, R, values, weight, prior, masks)
    q, r = np.linalg.qr(rows)
    inverse = np.linalg.inv(r)
    return inverse @ (q.T @ targets), inverse @ inverse.T


def true_cov(
    t: float,
    A: Between,
    times: Floats,
    H: Stack,
    R: Stack,
    weight: Weight,
    prior: Prior | None = None,
    masks: Stack | None = None,
) -> Array:
    """Return the error covariance of (8) under model (3), where the noise is not scaled by 1/W.

    The sandwich P [sum W^4 A'H'R^-1 H A] P with P of (9).
    """
    values = [np.zeros(matrix(h).shape[0]) for h in H]
    rows, _, weights = _stack(t, A, None, times, H, R, values, weight, prior, masks)
    P = np.linalg.inv(rows.T @ rows)
    weighted_again = rows * weights[:, None]
    return P @ (weighted_again.T @ weighted_again) @ P


def savgol_coefficients(
    window_length: int,
    polyorder: int,
    deriv: int = 0,
    delta: float = 1.0,
    pos: float | None = None,
) -> Array:
    """Return c with c @ window = the fitted polynomial's `deriv`-th derivative at sample `pos`.

    Dense polynomial least squares on equally spaced samples, oldest first; `pos` defaults to the
    centre and `window_length - 1` is the newest sample.
    """
    centre = (window_length - 1) / 2.0 if pos is None else pos
    grid = (np.arange(window_length) - centre) * delta
    design = grid[:, None] ** np.arange(polyorder + 1)
    fitted = np.linalg.lstsq(design, np.eye(window_length), rcond=None)[0]
    return math.factorial(deriv) * fitted[deriv]


def _stack(
    t: float,
    A: Between,
    offset: Between | None,
    times: Floats,
    H: Stack,
    R: Stack,
    values: Stack,
    weight: Weight,
    prior: Prior | None,
    masks: Stack | None,
) -> tuple[Array, Array, Array]:
    """Return the weighted, whitened rows, their targets, and the weight of each row."""
    data = [(t_l, *seen[:3]) for t_l, seen in zip(times, visible(H, R, values, masks), strict=True)]
    if prior is not None:
        mean, cov, t_prior = prior
        data.append((t_prior, np.eye(vector(mean).size), matrix(cov), vector(mean)))
    rows, targets, weights = [], [], []
    for t_l, h, r, value in data:
        known = np.zeros(h.shape[1]) if offset is None else vector(offset(t_l, t))
        w = weight(t_l, t)
        L = np.linalg.cholesky(r)
        rows.append(w * np.linalg.solve(L, h @ matrix(A(t_l, t))))
        targets.append(w * np.linalg.solve(L, value - h @ known))
        weights.append(np.full(value.size, w))
    stacked = np.vstack(rows)
    if np.linalg.matrix_rank(stacked) < stacked.shape[1]:
        raise np.linalg.LinAlgError("the measurements do not determine the state")
    return stacked, np.concatenate(targets), np.concatenate(weights)
