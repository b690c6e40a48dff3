"""Exact bias^2 + variance of a linear filter along a given truth: no sampling.

An estimator here is a function of the values (T, m) to the estimates (T, n), affine in them.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from .dense import Array, Between, Floats, Stack, block_diag, matrix

Estimator = Callable[[Array], Array]


def sine(amplitude: float, frequency_hz: float, dt: float, length: float) -> tuple[Array, Array]:
    """Return times 0, dt, ..., up to `length` included, and the sine there, both (T,)."""
    times = dt * np.arange(math.floor(length / dt + 1e-9) + 1)
    return times, amplitude * np.sin(2.0 * np.pi * frequency_hz * times)


def linear_operator(estimator: Estimator, steps: int, size: int) -> tuple[Array, Array]:
    """Return (L, c) with estimates = L z + c, by feeding zero and every unit vector.

    z is the values (steps, size) raveled; L has shape (steps, n, steps * size), c (steps, n).
    """
    c = estimator(np.zeros((steps, size)))
    units = np.eye(steps * size).reshape(-1, steps, size)
    return np.stack([estimator(unit) - c for unit in units], axis=-1), c


def bias_and_cov(
    estimator: Estimator, signal: ArrayLike, R: Stack, target: ArrayLike
) -> tuple[Array, Array]:
    """Return the exact mean error (T, n) and error covariance (T, n, n) at every time.

    `signal` (T, m) is H x along the truth, `target` (T, n) what the estimates should be.
    """
    signal = np.asarray(signal, dtype=np.float64)
    L, c = linear_operator(estimator, *signal.shape)
    noise = block_diag([matrix(r) for r in R])
    bias = L @ signal.ravel() + c - np.asarray(target, dtype=np.float64)
    return bias, L @ noise @ L.transpose(0, 2, 1)


def expected_mse(estimator: Estimator, signal: ArrayLike, R: Stack, target: ArrayLike) -> Array:
    """Return E|x_hat - x|^2 at every time, (T,): bias^2 + variance summed over the components."""
    bias, cov = bias_and_cov(estimator, signal, R, target)
    return np.sum(bias**2, axis=1) + np.trace(cov, axis1=1, axis2=2)


def ewif_estimator(
    times: Floats,
    A: Between,
    H: Stack,
    R: Stack,
    tau: float,
) -> Estimator:
    """Return the EWIF without prior, eqs. (26), (27) of Shulami & Sigalov, A(k-1, k) backward.

    Estimates are NaN until the information matrix has full rank.
    """
    fades, covs, information = [], [], np.zeros_like(matrix(A(times[0], times[0])))
    now = times[0]
    for t, h, r in zip(times, map(matrix, H), map(matrix, R), strict=True):
        back = matrix(A(now, t))
        fade = math.exp(-(t - now) / tau) * back.T
        information = fade @ information @ back + h.T @ np.linalg.solve(r, h)
        full_rank = np.linalg.matrix_rank(information) == len(information)
        covs.append(np.linalg.inv(information) if full_rank else np.full(back.shape, np.nan))
        fades.append(fade)
        now = t
    inputs = [np.linalg.solve(matrix(r), matrix(h)).T for h, r in zip(H, R, strict=True)]

    def estimate(values: Array) -> Array:
        vector, means = np.zeros(len(fades[0])), []
        for fade, cov, feed, value in zip(fades, covs, inputs, values, strict=True):
            vector = fade @ vector + feed @ value
            means.append(cov @ vector)
        return np.array(means)

    return estimate


def kalman_estimator(
    times: Floats,
    F: Between,
    Q: Between,
    H: Stack,
    R: Stack,
) -> Estimator:
    """Return the Kalman filter started by the first sample: H_1^-1 z_1, cov H_1^-1 R_1 H_1^-T."""
    start = np.linalg.inv(matrix(H[0]))
    cov = start @ matrix(R[0]) @ start.T
    closed_loops, gains = [], []
    for k in range(1, len(times)):
        f, h, r = matrix(F(times[k - 1], times[k])), matrix(H[k]), matrix(R[k])
        cov = f @ cov @ f.T + matrix(Q(times[k - 1], times[k]))
        K = np.linalg.solve(h @ cov @ h.T + r, h @ cov).T
        I_KH = np.eye(len(cov)) - K @ h
        cov = I_KH @ cov
        closed_loops.append(I_KH @ f)
        gains.append(K)

    def estimate(values: Array) -> Array:
        means = [start @ values[0]]
        for closed_loop, K, value in zip(closed_loops, gains, values[1:], strict=True):
            means.append(closed_loop @ means[-1] + K @ value)
        return np.array(means)

    return estimate
