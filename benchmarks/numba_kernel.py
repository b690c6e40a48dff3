"""The practical limit: a plain Numba Kalman filter with the runs in every innermost loop.

Runs are taken 64 at a time, so that one block's covariances (9 kB), gains and process noise stay
in the first-level cache for all steps, and every loop over the runs of a block becomes vector
instructions. Mean and covariance are updated in place. Arithmetic is float32 with fast-math.

What is assumed: 6 states, 2 measurements, F, H and R constant and shared, Q constant in time and
given for each run, covariances symmetric (one triangle is computed and mirrored), the 2x2
innovation covariance inverted in closed form. F and H are used as dense matrices: neither the
zeros nor the ones of the kinematic F are exploited.
"""

import numpy as np
from numba import njit, prange

BLOCK = 64


@njit(fastmath=True, parallel=True)
def filter_all(F, H, R, Q, prior_mean, prior_cov, value, mean):
    """Fill `mean` ``(runs, steps, 6)`` from `value` ``(runs, steps, 2)``, Q ``(6, 6, runs)``."""
    runs = value.shape[0]
    for block in prange((runs + BLOCK - 1) // BLOCK):
        start = block * BLOCK
        _filter_block(
            F, H, R, Q, prior_mean, prior_cov, value, mean, start, min(BLOCK, runs - start)
        )


@njit(fastmath=True)
def _filter_block(F, H, R, Q, prior_mean, prior_cov, value, mean, start, width):
    stop = start + width
    m = np.empty((6, BLOCK), np.float32)
    P = np.empty((6, 6, BLOCK), np.float32)
    FP = np.empty((6, 6, BLOCK), np.float32)
    Q_block = np.empty((6, 6, BLOCK), np.float32)
    PHt = np.empty((6, 2, BLOCK), np.float32)
    K = np.empty((6, 2, BLOCK), np.float32)
    for i in range(6):
        m[i] = prior_mean[i]
        for j in range(6):
            P[i, j] = prior_cov[i, j]
            Q_block[i, j, :width] = Q[i, j, start:stop]

    for t in range(value.shape[1]):
        _predict(F, Q_block, m, P, FP, width)
        _gain(H, R, P, PHt, K, width)
        _correct(H, K, value[start:stop, t, 0], value[start:stop, t, 1], m, width)
        for i in range(6):
            output = mean[start:stop, t, i]
            for r in range(width):
                output[r] = m[i, r]
            for j in range(i + 1):
                for r in range(width):
                    p = P[i, j, r] - K[i, 0, r] * PHt[j, 0, r] - K[i, 1, r] * PHt[j, 1, r]
                    P[i, j, r] = p
                    P[j, i, r] = p


@njit(fastmath=True, inline="always")
def _predict(F, Q, m, P, FP, width):
    """``m = F m`` and ``P = F P F' + Q`` in place; `FP` is scratch."""
    for r in range(width):
        m0, m1, m2, m3, m4, m5 = m[0, r], m[1, r], m[2, r], m[3, r], m[4, r], m[5, r]
        for i in range(6):
            m[i, r] = (
                F[i, 0] * m0 + F[i, 1] * m1 + F[i, 2] * m2
                + F[i, 3] * m3 + F[i, 4] * m4 + F[i, 5] * m5
            )  # fmt: skip
    for j in range(6):
        for i in range(6):
            f0, f1, f2, f3, f4, f5 = F[i, 0], F[i, 1], F[i, 2], F[i, 3], F[i, 4], F[i, 5]
            for r in range(width):
                FP[i, j, r] = (
                    f0 * P[0, j, r] + f1 * P[1, j, r] + f2 * P[2, j, r]
                    + f3 * P[3, j, r] + f4 * P[4, j, r] + f5 * P[5, j, r]
                )  # fmt: skip
    for i in range(6):
        for j in range(i + 1):
            f0, f1, f2, f3, f4, f5 = F[j, 0], F[j, 1], F[j, 2], F[j, 3], F[j, 4], F[j, 5]
            for r in range(width):
                p = Q[i, j, r] + (
                    FP[i, 0, r] * f0 + FP[i, 1, r] * f1 + FP[i, 2, r] * f2
                    + FP[i, 3, r] * f3 + FP[i, 4, r] * f4 + FP[i, 5, r] * f5
                )  # fmt: skip
                P[i, j, r] = p
                P[j, i, r] = p


@njit(fastmath=True, inline="always")
def _gain(H, R, P, PHt, K, width):
    """``P H'`` and the gain ``P H' inv(H P H' + R)``."""
    for i in range(6):
        for k in range(2):
            h0, h1, h2, h3, h4, h5 = H[k, 0], H[k, 1], H[k, 2], H[k, 3], H[k, 4], H[k, 5]
            for r in range(width):
                PHt[i, k, r] = (
                    P[i, 0, r] * h0 + P[i, 1, r] * h1 + P[i, 2, r] * h2
                    + P[i, 3, r] * h3 + P[i, 4, r] * h4 + P[i, 5, r] * h5
                )  # fmt: skip
    for r in range(width):
        s00, s01, s11 = R[0, 0], R[0, 1], R[1, 1]
        for i in range(6):
            s00 += H[0, i] * PHt[i, 0, r]
            s01 += H[0, i] * PHt[i, 1, r]
            s11 += H[1, i] * PHt[i, 1, r]
        scale = np.float32(1.0) / (s00 * s11 - s01 * s01)
        for i in range(6):
            g0, g1 = PHt[i, 0, r], PHt[i, 1, r]
            K[i, 0, r] = (g0 * s11 - g1 * s01) * scale
            K[i, 1, r] = (g1 * s00 - g0 * s01) * scale


@njit(fastmath=True, inline="always")
def _correct(H, K, value0, value1, m, width):
    """``m += K (value - H m)`` in place."""
    for r in range(width):
        v0, v1 = value0[r], value1[r]
        for i in range(6):
            v0 -= H[0, i] * m[i, r]
            v1 -= H[1, i] * m[i, r]
        for i in range(6):
            m[i, r] += K[i, 0, r] * v0 + K[i, 1, r] * v1
