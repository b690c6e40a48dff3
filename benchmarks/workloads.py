r"""Seeded NumPy data for the speed measurements, the same for every package that is timed.

The motion is constant acceleration driven by white-noise jerk, per axis

.. math:: F(h) = \begin{pmatrix} 1 & h & h^2/2 \\ 0 & 1 & h \\ 0 & 0 & 1 \end{pmatrix}, \quad
          Q(h) = q \begin{pmatrix} h^5/20 & h^4/8 & h^3/6 \\ h^4/8 & h^3/3 & h^2/2 \\
                                    h^3/6 & h^2/2 & h \end{pmatrix},

and two axes are stacked derivative by derivative, ``[x, y, vx, vy, ax, ay]``. The prior belongs
to time 0 and no measurement is earlier: a filter predicts first, then updates.
"""

from typing import NamedTuple

import numpy as np

PRIOR_VARIANCE = (25.0, 4.0, 0.25)  # position, velocity, acceleration
Q_SPREAD = 10.0  # per-run q lies in [q / Q_SPREAD, q * Q_SPREAD]


class L1(NamedTuple):
    """Regular steps: measurement ``k`` is taken at ``(k + 1) * dt``."""

    F: np.ndarray  # (6, 6)
    H: np.ndarray  # (2, 6)
    Q: np.ndarray  # (6, 6) shared, or (runs, 6, 6) per run
    R: np.ndarray  # (2, 2)
    chol_Q: np.ndarray  # lower Cholesky factor of Q, computed in float64
    prior_mean: np.ndarray  # (6,)
    prior_cov: np.ndarray  # (6, 6)
    q: np.ndarray  # () shared, or (runs,) per run
    time: np.ndarray  # (steps,)
    value: np.ndarray  # (runs, steps, 2)
    truth: np.ndarray  # (runs, steps, 6)

    @property
    def per_run(self) -> bool:
        """Whether every run has its own process noise."""
        return self.Q.ndim == 3


class L2(NamedTuple):
    """Irregular times that differ by run, stacked in order of arrival; some measurements late."""

    H: np.ndarray  # (2, 6)
    R: np.ndarray  # (2, 2)
    prior_mean: np.ndarray  # (6,)
    prior_cov: np.ndarray  # (6, 6)
    q: np.ndarray  # (runs,)
    time: np.ndarray  # (runs, steps) when the value was true
    arrival: np.ndarray  # (runs, steps) when it arrived, increasing along steps
    value: np.ndarray  # (runs, steps, 2)
    delayed: np.ndarray  # (runs, steps) bool, whether a delay was drawn for it
    truth: np.ndarray  # (runs, steps, 6) at `time`

    @property
    def lag(self) -> int:
        """The most sampling intervals by which a measurement trails the newest one before it."""
        order = np.argsort(np.argsort(self.time, axis=1), axis=1)
        return int((np.maximum.accumulate(order, axis=1) - order).max())


class L3(NamedTuple):
    """One long series: a sine position seen through white noise, states position to acceleration.

    Measurement ``k`` is taken at ``(k + 1) * dt``.
    """

    F: np.ndarray  # (3, 3)
    H: np.ndarray  # (1, 3)
    R: np.ndarray  # (1, 1)
    dt: float
    time: np.ndarray  # (steps,)
    value: np.ndarray  # (steps, 1)
    truth: np.ndarray  # (steps, 3)


def axis_transition(dt) -> np.ndarray:
    """F of one axis, shape ``dt.shape + (3, 3)``."""
    dt = np.asarray(dt, float)
    one, zero = np.ones_like(dt), np.zeros_like(dt)
    rows = ((one, dt, dt**2 / 2), (zero, one, dt), (zero, zero, one))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def axis_process_cov(dt, q) -> np.ndarray:
    """Q of one axis, of the broadcast shape of `dt` and `q` followed by ``(3, 3)``."""
    factor = axis_process_factor(dt, q)
    return factor @ np.swapaxes(factor, -1, -2)


def axis_process_factor(dt, q) -> np.ndarray:
    """Lower Cholesky factor of Q of one axis: that of ``dt = q = 1`` with its rows scaled."""
    dt, q = np.broadcast_arrays(np.asarray(dt, float), np.asarray(q, float))
    unit = np.linalg.cholesky([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1]])
    scale = np.sqrt(q * dt)[..., None] * np.stack([dt**2, dt, np.ones_like(dt)], axis=-1)
    return scale[..., None] * unit


def both_axes(matrix: np.ndarray) -> np.ndarray:
    """``kron(matrix, I2)`` over the last two axes."""
    n, m = matrix.shape[-2:]
    product = np.einsum("...ij,ab->...iajb", matrix, np.eye(2))
    return product.reshape(*matrix.shape[:-2], 2 * n, 2 * m)


def constant_acceleration(
    runs: int = 1024,
    steps: int = 1000,
    *,
    per_run: bool = False,
    dt: float = 0.1,
    q: float = 0.01,
    r: float = 1.0,
    seed: int = 0,
    dtype=np.float32,
) -> L1:
    """L1: (a) one `q` for all runs, or (b) with `per_run` log-uniform around it."""
    rng = np.random.default_rng(seed)
    q_used = _spread(rng, q, runs) if per_run else np.asarray(q)
    chol_Q = both_axes(axis_process_factor(dt, q_used))
    gaps = np.full((runs, steps), dt)
    truth = _simulate(rng, gaps, np.broadcast_to(q_used, runs))
    value = truth[..., :2] + np.sqrt(r) * rng.standard_normal((runs, steps, 2))
    workload = L1(
        F=both_axes(axis_transition(dt)),
        H=np.eye(2, 6),
        Q=chol_Q @ np.swapaxes(chol_Q, -1, -2),
        R=r * np.eye(2),
        chol_Q=chol_Q,
        prior_mean=np.zeros(6),
        prior_cov=np.diag(np.repeat(PRIOR_VARIANCE, 2)),
        q=q_used,
        time=dt * np.arange(1, steps + 1),
        value=value,
        truth=truth,
    )
    return L1(*(np.ascontiguousarray(array, dtype).reshape(array.shape) for array in workload))


def irregular_and_late(
    runs: int = 1024,
    steps: int = 1000,
    *,
    dt: float = 0.1,
    q: float = 0.01,
    r: float = 1.0,
    late: float = 0.3,
    mean_delay: float = 0.3,
    seed: int = 0,
    dtype=np.float32,
) -> L2:
    """L2: gaps uniform on ``[dt / 2, 3 dt / 2]``; a share `late` delayed exponentially."""
    rng = np.random.default_rng(seed)
    q_used = _spread(rng, q, runs)
    gaps = dt * rng.uniform(0.5, 1.5, (runs, steps))
    time = np.cumsum(gaps, axis=1)
    truth = _simulate(rng, gaps, q_used)
    value = truth[..., :2] + np.sqrt(r) * rng.standard_normal((runs, steps, 2))
    delayed = rng.random((runs, steps)) < late
    arrival = time + np.where(delayed, rng.exponential(mean_delay, (runs, steps)), 0.0)
    order = np.argsort(arrival, axis=1, kind="stable")

    def sort(array):
        return np.take_along_axis(array, order.reshape(order.shape + (1,) * (array.ndim - 2)), 1)

    return L2(
        H=np.eye(2, 6, dtype=dtype),
        R=r * np.eye(2, dtype=dtype),
        prior_mean=np.zeros(6, dtype),
        prior_cov=np.diag(np.repeat(PRIOR_VARIANCE, 2)).astype(dtype),
        q=q_used.astype(dtype),
        time=sort(time).astype(dtype),
        arrival=sort(arrival).astype(dtype),
        value=sort(value).astype(dtype),
        delayed=sort(delayed),
        truth=sort(truth).astype(dtype),
    )


def long_series(
    steps: int = 1_000_000,
    *,
    dt: float = 0.1,
    amplitude: float = 10.0,
    period: float = 60.0,
    r: float = 1.0,
    seed: int = 0,
    dtype=np.float64,
) -> L3:
    """L3: one series of a sine, which stays bounded however long the series is."""
    rng = np.random.default_rng(seed)
    time = dt * np.arange(1, steps + 1)
    rate = 2 * np.pi / period
    sine, cosine = np.sin(rate * time), np.cos(rate * time)
    truth = amplitude * np.stack([sine, rate * cosine, -(rate**2) * sine], axis=1)
    value = truth[:, :1] + np.sqrt(r) * rng.standard_normal((steps, 1))
    return L3(
        F=axis_transition(dt).astype(dtype),
        H=np.eye(1, 3, dtype=dtype),
        R=np.full((1, 1), r, dtype),
        dt=dt,
        time=time.astype(dtype),
        value=value.astype(dtype),
        truth=truth.astype(dtype),
    )


def _spread(rng: np.random.Generator, q: float, runs: int) -> np.ndarray:
    """Log-uniform draws of the process noise, one for each run."""
    return q * Q_SPREAD ** rng.uniform(-1.0, 1.0, runs)


def _simulate(rng: np.random.Generator, gaps: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Draw true states ``(runs, steps, 6)`` after each gap, from the prior at time 0 on."""
    runs, steps = gaps.shape
    deviation = np.sqrt(PRIOR_VARIANCE)[:, None]
    state = deviation * rng.standard_normal((runs, 3, 2))  # rows: derivatives, columns: x and y
    truth = np.empty((runs, steps, 6))
    for k in range(steps):
        noise = axis_process_factor(gaps[:, k], q) @ rng.standard_normal((runs, 3, 2))
        state = axis_transition(gaps[:, k]) @ state + noise
        truth[:, k] = state.reshape(runs, 6)
    return truth
