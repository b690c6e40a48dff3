"""Textbook unscented filter and smoother (van der Merwe 2004; Sarkka 2008), one point at a time."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from .dense import Array, matrix, vector

Function = Callable[[Array], ArrayLike]
Subtract = Callable[[Array, Array], Array]


def unscented_moments(
    f: Function,
    mean: ArrayLike,
    cov: ArrayLike,
    ut_alpha: float,
    ut_beta: float,
    ut_kappa: float,
    subtract: Subtract = np.subtract,
) -> tuple[Array, Array, Array]:
    """Return mean and covariance of f(x), and the cross-covariance of x with f(x)."""
    x, P = vector(mean), matrix(cov)
    n = x.size
    spread = ut_alpha**2 * (n + ut_kappa) - n
    root = np.linalg.cholesky((n + spread) * P)
    points = [x, *(x + c for c in root.T), *(x - c for c in root.T)]
    weights = np.full(2 * n + 1, 0.5 / (n + spread))
    weights[0] = spread / (n + spread)
    cov_weights = weights.copy()
    cov_weights[0] += 1.0 - ut_alpha**2 + ut_beta
    values = [vector(f(p)) for p in points]
    offsets = [subtract(v, values[0]) for v in values]
    shift = sum(w * o for w, o in zip(weights, offsets, strict=True))
    Pyy = sum(w * np.outer(o - shift, o - shift) for w, o in zip(cov_weights, offsets, strict=True))
    Pxy = sum(
        w * np.outer(p - x, o - shift) for w, p, o in zip(cov_weights, points, offsets, strict=True)
    )
    return values[0] + shift, Pyy, Pxy


def unscented_smoother(
    move: Callable[[Array, float, float], ArrayLike],
    Q: Callable[[float, float], ArrayLike],
    see: Callable[[Array, int], ArrayLike],
    R: ArrayLike,
    subtract: Subtract,
    *,
    t0: float,
    mean: ArrayLike,
    cov: ArrayLike,
    times: ArrayLike,
    values: ArrayLike,
    sensors: ArrayLike,
    settings: tuple[float, float, float],
) -> tuple[list[tuple[Array, Array]], list[tuple[Array, Array]]]:
    """Return the filtered and the smoothed (mean, cov) at each measurement."""
    x, P = vector(mean), matrix(cov)
    filtered, forward = [], []
    for (a, t), z, s in zip(pairwise([t0, *vector(times)]), matrix(values), sensors, strict=True):
        y, Pyy, Pxy = unscented_moments(lambda p, a=a, t=t: move(p, a, t), x, P, *settings)
        forward.append((y, Pyy + matrix(Q(a, t)), Pxy))
        x, P = forward[-1][:2]
        y, Pyy, Pxy = unscented_moments(lambda p, s=s: see(p, s), x, P, *settings, subtract)
        S = Pyy + matrix(R)
        K = Pxy @ np.linalg.inv(S)
        x, P = x + K @ subtract(z, y), P - K @ S @ K.T
        filtered.append((x, P))
    smoothed = [filtered[-1]]
    for (x, P), (y, Pyy, Pxy) in zip(filtered[-2::-1], forward[:0:-1], strict=True):
        G = Pxy @ np.linalg.inv(Pyy)
        later_mean, later_cov = smoothed[0]
        smoothed.insert(0, (x + G @ (later_mean - y), P + G @ (later_cov - Pyy) @ G.T))
    return filtered, smoothed
