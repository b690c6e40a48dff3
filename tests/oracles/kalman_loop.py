"""Textbook Kalman loop and Anderson's (1973, sec. 5) exponentially weighted one, in time order.

Anderson's H' is our H, his G Q G' our Q. `alphas[k]` belongs to the step into measurement k.
"""

from typing import NamedTuple

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
    psd_factor,
    trajectory_map,
    vector,
    visible,
)


class Track(NamedTuple):
    """What a loop returns, one entry per measurement; masked components have zero gain."""

    means: Array
    covs: Array
    gains: list[Array]
    innovations: list[Array]
    innovation_covs: list[Array]
    log_likelihoods: Array


def kalman_filter(
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
) -> Track:
    """Return the Kalman filter's track, eqs. (5-8)-(5-11) with an input b."""
    return fading_filter(
        t0=t0,
        prior_mean=prior_mean,
        prior_cov=prior_cov,
        F=F,
        Q=Q,
        times=times,
        H=H,
        R=R,
        values=values,
        alphas=np.ones(len(times)),
        b=b,
        masks=masks,
    )


def fading_filter(
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
    alphas: ArrayLike,
    b: Between | None = None,
    masks: Stack | None = None,
) -> Track:
    """Return the track of the weighted filter, eqs. (5-8), (5-13)-(5-15); `covs` is Pi.

    Innovations hold the visible components only. A step of no elapsed time still fades.
    """
    mean, cov, now = vector(prior_mean), matrix(prior_cov), t0
    n = mean.size
    track: list[tuple] = []
    data = visible(H, R, values, masks)
    for t, alpha, (h, r, z, seen) in zip(times, vector(alphas), data, strict=True):
        f, q, known = interval(now, t, n, F, Q, b)
        mean = f @ mean + known
        cov = alpha**2 * f @ cov @ f.T + q  # (5-14)
        S = h @ cov @ h.T + r
        K = np.linalg.solve(S, h @ cov).T  # (5-13)
        innovation = z - h @ mean
        mean = mean + K @ innovation  # (5-8)
        I_KH = np.eye(n) - K @ h
        cov = I_KH @ cov @ I_KH.T + K @ r @ K.T  # (5-15)
        log_det = np.linalg.slogdet(2.0 * np.pi * S)[1]
        log_density = -0.5 * (log_det + innovation @ np.linalg.solve(S, innovation))
        gain = np.zeros((n, seen.size))
        gain[:, seen] = K
        track.append((mean, cov, gain, innovation, S, log_density))
        now = t
    means, covs, gains, innovations, innovation_covs, log_densities = zip(*track, strict=True)
    return Track(
        np.array(means),
        np.array(covs),
        list(gains),
        list(innovations),
        list(innovation_covs),
        np.array(log_densities),
    )


def weighted_cost_minimiser(
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
    alphas: ArrayLike,
    b: Between | None = None,
    masks: Stack | None = None,
) -> tuple[Array, Array]:
    """Return the states x(k0), ..., x(k) minimising (5-6) with weights (5-7), and Pi(k), (5-12).

    The prior has weight 1; R(l) and Q(l) are divided by the product of alpha^2 up to l. Unknowns
    are unit-covariance e with x(k0) = mean + L_0 e_0 and noise L_l e_l, so that singular P0 and Q
    need no pseudo-inverse: their ranges are the constraint.
    """
    n, steps_count = vector(prior_mean).size, len(times)
    starts = [t0, *times[:-1]]
    steps = [interval(a, c, n, F, Q, b) for a, c in zip(starts, times, strict=True)]
    T = trajectory_map([f for f, _, _ in steps], n)
    nominal = T @ np.concatenate([vector(prior_mean), *(c for _, _, c in steps)])
    noise = T @ block_diag([psd_factor(prior_cov), *(psd_factor(q) for _, q, _ in steps)])

    scale = np.cumprod(vector(alphas))
    rows = [np.diag(np.repeat([1.0, *scale], n))]
    targets = [np.zeros(n * (steps_count + 1))]
    for k, (h, r, z, _) in enumerate(visible(H, R, values, masks), start=1):
        state = slice(k * n, (k + 1) * n)
        L = np.linalg.cholesky(r)
        rows.append(scale[k - 1] * np.linalg.solve(L, h @ noise[state]))
        targets.append(scale[k - 1] * np.linalg.solve(L, z - h @ nominal[state]))
    stacked, target = np.vstack(rows), np.concatenate(targets)
    e = np.linalg.lstsq(stacked, target, rcond=None)[0]
    last = noise[-n:]
    P_alpha = last @ np.linalg.solve(stacked.T @ stacked, last.T)
    return (nominal + noise @ e).reshape(steps_count + 1, n), scale[-1] ** 2 * P_alpha


def actual_error(
    *,
    t0: float,
    prior_cov: ArrayLike,
    F: Between,
    Q: Between,
    times: Floats,
    H: Stack,
    R: Stack,
    gains: Stack,
) -> Array:
    """Return the actual error covariance after each update with the given gains, (5-19), (5-20).

    F, Q, H, R describe the true system, which need not be the one that gave the gains.
    """
    E, now, errors = matrix(prior_cov), t0, []
    n = E.shape[0]
    for t, h, r, K in zip(times, map(matrix, H), map(matrix, R), map(matrix, gains), strict=True):
        f, q, _ = interval(now, t, n, F, Q)
        E = f @ E @ f.T + q
        I_KH = np.eye(n) - K @ h
        E = I_KH @ E @ I_KH.T + K @ r @ K.T
        errors.append(E)
        now = t
    return np.array(errors)
