"""Exact linear-Gaussian posterior: one dense joint over all distinct times, conditioned once.

Measurements may come in any order, at any times from t0 on. `F(t0, t1)`, `Q(t0, t1)` and
`b(t0, t1)` are asked for consecutive distinct times only, t0 < t1, the evaluation time included;
so use a process noise that composes over sub-intervals.
"""

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from .dense import (
    Array,
    Between,
    Floats,
    Stack,
    block_diag,
    interval,
    matrix,
    trajectory_map,
    vector,
    visible,
)


def joint(
    times: Floats,
    *,
    t0: float,
    prior_mean: ArrayLike,
    prior_cov: ArrayLike,
    F: Between,
    Q: Between,
    b: Between | None = None,
) -> tuple[Array, Array, Array]:
    """Return (grid, mean, cov) of the states at t0 and all distinct `times`, stacked in time order.

    With X = T E, E the prior state and the process noises: cov(X) = T blockdiag(P0, Q1, ...) T'.
    """
    grid = np.unique(np.array([t0, *times], dtype=np.float64))
    if grid[0] < t0:
        raise ValueError(f"a time, {grid[0]}, is earlier than t0 = {t0}")
    n = vector(prior_mean).size
    steps = [interval(a, c, n, F, Q, b) for a, c in pairwise(grid)]
    T = trajectory_map([f for f, _, _ in steps], n)
    mean = T @ np.concatenate([vector(prior_mean), *(c for _, _, c in steps)])
    cov = T @ block_diag([matrix(prior_cov), *(q for _, q, _ in steps)]) @ T.T
    return grid, mean, cov


def posterior(
    t_eval: float,
    *,
    t0: float,
    prior_mean: ArrayLike,
    prior_cov: ArrayLike,
    F: Between,
    Q: Between,
    times: Floats,
    H: Stack,
    R: Stack,
    values: Stack,
    b: Between | None = None,
    masks: Stack | None = None,
) -> tuple[Array, Array]:
    """Return mean and covariance of x(t_eval) given all the measurements, earlier or later."""
    grid, mean, cov = joint(
        [*times, t_eval], t0=t0, prior_mean=prior_mean, prior_cov=prior_cov, F=F, Q=Q, b=b
    )
    n = vector(prior_mean).size
    pick = _selector(grid, t_eval, n)
    mean_x, cov_x = pick @ mean, pick @ cov @ pick.T
    H_all, R_all, z = _stack(grid, n, times, H, R, values, masks)
    S = H_all @ cov @ H_all.T + R_all
    cross = pick @ cov @ H_all.T
    gain = np.linalg.solve(S, cross.T).T
    cov_post = cov_x - gain @ cross.T
    return mean_x + gain @ (z - H_all @ mean), (cov_post + cov_post.T) / 2.0


def log_likelihood(
    *,
    t0: float,
    prior_mean: ArrayLike,
    prior_cov: ArrayLike,
    F: Between,
    Q: Between,
    times: Floats,
    H: Stack,
    R: Stack,
    values: Stack,
    b: Between | None = None,
    masks: Stack | None = None,
) -> float:
    """Return the log density of all the measurements jointly, masked components left out."""
    grid, mean, cov = joint(times, t0=t0, prior_mean=prior_mean, prior_cov=prior_cov, F=F, Q=Q, b=b)
    H_all, R_all, z = _stack(grid, vector(prior_mean).size, times, H, R, values, masks)
    S = H_all @ cov @ H_all.T + R_all
    error = z - H_all @ mean
    log_det = np.linalg.slogdet(2.0 * np.pi * S)[1]
    return float(-0.5 * (log_det + error @ np.linalg.solve(S, error)))


def _selector(grid: Array, t: float, n: int) -> Array:
    """Return the matrix that picks x(t) out of the stacked states."""
    return np.kron((grid == t).astype(np.float64), np.eye(n))


def _stack(
    grid: Array,
    n: int,
    times: Floats,
    H: Stack,
    R: Stack,
    values: Stack,
    masks: Stack | None,
) -> tuple[Array, Array, Array]:
    """Return (H, R, z) of all measurements as one measurement of the stacked states."""
    data = list(visible(H, R, values, masks))
    rows = [h @ _selector(grid, t, n) for t, (h, *_) in zip(times, data, strict=True)]
    H_all = np.vstack([np.zeros((0, n * grid.size)), *rows])
    z = np.concatenate([np.zeros(0), *(value for _, _, value, _ in data)])
    return H_all, block_diag([r for _, r, _, _ in data]), z
