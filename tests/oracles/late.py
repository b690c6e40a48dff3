"""One late measurement: Al1 and Bl1 (appendix (71)-(86) of Pornsarayouth & Yamakita, corrected).

And the merit of a late one: delayed gain, cut-off and Algorithms 1 and 2 of Yoder et al. (2018).
"""

import math
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from .dense import Array, Between, Floats, interval, matrix, vector

State = TypeVar("State")


class Interval(NamedTuple):
    """What Al1 and Bl1 know about t_{k-l} <= t_d <= t_k."""

    predicted_mean: Array  # x(k | k-l)
    predicted_cov: Array  # M = P(k | k-l)
    F: Array  # F(k, d), from the late time to now
    Q: Array  # Q(k, d)
    b: Array  # the known input between them


def lag_interval(
    t_start: float,
    start_mean: ArrayLike,
    start_cov: ArrayLike,
    t_late: float,
    t_now: float,
    F: Between,
    Q: Between,
    b: Between | None = None,
) -> Interval:
    """Return the interval quantities from the estimate at t_start = t_{k-l} alone."""
    mean, cov = vector(start_mean), matrix(start_cov)
    if not t_start <= t_late <= t_now:
        raise ValueError(f"expected {t_start} <= {t_late} <= {t_now}")
    whole_F, whole_Q, whole_b = interval(t_start, t_now, mean.size, F, Q, b)
    return Interval(
        whole_F @ mean + whole_b,
        whole_F @ cov @ whole_F.T + whole_Q,
        *interval(t_late, t_now, mean.size, F, Q, b),
    )


def al1(
    mean: ArrayLike, cov: ArrayLike, lag: Interval, H: ArrayLike, R: ArrayLike, value: ArrayLike
) -> tuple[Array, Array]:
    """Return x(k), P(k) after the late `value`: (9), (10), (74)-(79) with the noise estimate

    v = Q M^-1 (x(k|k) - x(k|k-l)), P_vv = Q - Q (M^-1 - M^-1 P M^-1) Q, P_xv = P M^-1 Q.
    """
    x, P, Q = vector(mean), matrix(cov), lag.Q
    M_inv = np.linalg.inv(lag.predicted_cov)
    v = Q @ M_inv @ (x - lag.predicted_mean)
    P_vv = Q - Q @ (M_inv - M_inv @ P @ M_inv) @ Q
    return _retrodict_and_update(x, P, v, P_vv, P @ M_inv @ Q, lag, H, R, value)


def bl1(
    mean: ArrayLike, cov: ArrayLike, lag: Interval, H: ArrayLike, R: ArrayLike, value: ArrayLike
) -> tuple[Array, Array]:
    """Return x(k), P(k) after the late `value` with v = 0, P_vv = Q, P_xv = P M^-1 Q."""
    x, P, Q = vector(mean), matrix(cov), lag.Q
    P_xv = P @ np.linalg.inv(lag.predicted_cov) @ Q
    return _retrodict_and_update(x, P, np.zeros_like(x), Q, P_xv, lag, H, R, value)


def al1_as_kalman_update(
    mean: ArrayLike, cov: ArrayLike, lag: Interval, H: ArrayLike, R: ArrayLike, value: ArrayLike
) -> tuple[Array, Array]:
    """Return Al1 written as one Kalman update of x(k):

    H~ = H F^-1 (I - Q M^-1), R~ = R + H F^-1 (Q - Q M^-1 Q) F^-T H', and
    offset H F^-1 (Q M^-1 x(k|k-l) - b).
    """
    x, P, Q = vector(mean), matrix(cov), lag.Q
    M_inv = np.linalg.inv(lag.predicted_cov)
    HF = matrix(H) @ np.linalg.inv(lag.F)
    H_now = HF @ (np.eye(x.size) - Q @ M_inv)
    R_now = matrix(R) + HF @ (Q - Q @ M_inv @ Q) @ HF.T
    offset = HF @ (Q @ M_inv @ lag.predicted_mean - lag.b)
    S = H_now @ P @ H_now.T + R_now
    K = np.linalg.solve(S, H_now @ P).T
    return x + K @ (vector(value) - H_now @ x - offset), P - K @ S @ K.T


def _retrodict_and_update(
    x: Array,
    P: Array,
    v: Array,
    P_vv: Array,
    P_xv: Array,
    lag: Interval,
    H: ArrayLike,
    R: ArrayLike,
    value: ArrayLike,
) -> tuple[Array, Array]:
    """Return (9), (10) with (74), (75), (77)-(79)."""
    H = matrix(H)
    back = np.linalg.inv(lag.F)
    z = H @ back @ (x - v - lag.b)
    P_late = back @ (P + P_vv - P_xv - P_xv.T) @ back.T
    P_zz = H @ P_late @ H.T + matrix(R)
    P_xz = (P - P_xv) @ back.T @ H.T
    K = np.linalg.solve(P_zz, P_xz.T).T
    return x + K @ (vector(value) - z), P - K @ P_xz.T


def steady_gain(
    F: ArrayLike, H: ArrayLike, Q: ArrayLike, R: ArrayLike, iterations: int = 1_000_000
) -> Array:
    """Return the steady Kalman gain (n, m): the Riccati equation (3) iterated until it stands."""
    F, H, Q, R = matrix(F), matrix(H), matrix(Q), matrix(R)
    C = Q + np.eye(len(Q))
    for _ in range(iterations):
        K = np.linalg.solve(H @ C @ H.T + R, H @ C).T
        C_next = F @ (C - K @ H @ C) @ F.T + Q
        C_next = (C_next + C_next.T) / 2.0
        if np.max(np.abs(C_next - C)) <= 1e-15 * np.max(np.abs(C)):
            return K
        C = C_next
    raise ArithmeticError("the Riccati iteration did not converge")


def delayed_gain(F: ArrayLike, H: ArrayLike, Q: ArrayLike, R: ArrayLike, steps: int) -> Array:
    """Return ((I - K H) F)^steps K, eq. (5): the gain of a measurement `steps` intervals old."""
    F, H = matrix(F), matrix(H)
    K = steady_gain(F, H, Q, R)
    return np.linalg.matrix_power((np.eye(len(F)) - K @ H) @ F, steps) @ K


def cutoff_delay(sigma_q: float, sigma_r: float, dt: float, ratio: float) -> float:
    """Return T_d of eq. (8) for the random walk: the delay at which the gain is `ratio` of k."""
    k = steady_gain(1.0, 1.0, sigma_q**2 * dt, sigma_r**2).item()
    return dt * math.log(ratio) / math.log(1.0 - k)


def ideal_gains(
    intervals: Floats, sigma_q: float, sigma_r: float, first_cov: float, h: float = 1.0
) -> Array:
    """Return Algorithm 1, corrected: row j-1 has k(j, l), the weight of value j - l in estimate j.

    l = j is the weight of the initial estimate, whose predicted variance c^p(1) is `first_cov`;
    later entries are zero. `intervals[j-1]` leads from measurement j to j + 1.
    """
    n = len(intervals) + 1
    gains = np.zeros((n, n + 1))
    predicted = np.zeros(n + 2)
    predicted[1], c = 1.0, first_cov
    for j in range(1, n + 1):
        k = c * h / (h**2 * c + sigma_r**2)
        gains[j - 1, 0] = k
        gains[j - 1, 1:] = (1.0 - k * h) * predicted[1 : n + 1]
        predicted[1:] = gains[j - 1]
        if j < n:
            c = (1.0 - k * h) * c + intervals[j - 1] * sigma_q**2
    return gains


def selective_filter(
    update: Callable[[State, int], State], state: State, times: Floats, max_delay: float
) -> tuple[State, list[bool]]:
    """Return Algorithm 2, corrected: the final state, and which arrivals were used.

    `update(state, k)` processes arrival k. It is called where
    (last estimate time - measurement time) < max_delay; the last estimate time never goes back.
    """
    last, used = -math.inf, []
    for k, t in enumerate(times):
        used.append(last - t < max_delay)
        if used[-1]:
            state = update(state, k)
            last = max(last, t)
    return state, used
