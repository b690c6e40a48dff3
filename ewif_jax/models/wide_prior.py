"""Whether a covariance in the filter's floats can hold a prior: what is refused before tracing."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.sparse import dense
from ewif_jax.models.linearise import predict_measurement, predict_state
from ewif_jax.models.model import Model
from ewif_jax.types import DTypeLike, Gaussian, Measurement, Numbers, Params

LIMIT = 0.1
"""The share of a variance that may be rounding. In 12 rows of a constant velocity seen through 0.1
m, 90 runs in float32: 0.07 (a prior 1e6 times R) is off by 0.005 sigma at most, 0.6 (1e7) by 0.04,
6 (1e8) by 0.8 and has negative variances."""


def first_rows(measurements: Measurement, prior: Gaussian | None, t0: Numbers) -> Any:
    """Times and sensors of the first measurements that come in sequence, which tell whether a prior
    is too wide; None where something of it is traced."""
    given = prior, t0, measurements.time, measurements.sensor, measurements.mask
    concrete = all(checks.concrete_value(x) is not None for x in jax.tree.leaves(given))
    if prior is None or not concrete or np.ndim(measurements.time) != 1:
        return None
    seen = np.flatnonzero(np.asarray(measurements.mask).any(-1))[: 4 * np.shape(prior.cov)[0]]
    times = np.asarray(measurements.time, float)[seen]
    in_sequence = times >= np.maximum.accumulate(np.append(float(t0), times))[:-1]
    sensors = np.asarray(measurements.sensor, np.int32)[seen]
    return (times[in_sequence], sensors[in_sequence]) if in_sequence.any() else None


def check_prior_width(
    model: Model, params: Params, prior: Gaussian, t0: Numbers, rows: Numbers, dtype: DTypeLike
) -> bool:
    """True, unless a known prior is so wide that the first updates (`first_rows`) leave variances
    that are mostly what a covariance in `dtype` was rounded by: that is refused."""
    cov = np.asarray(prior.cov, float)
    eps = float(jnp.finfo(dtype).eps)
    times, sensors = rows
    with jax.ensure_compile_time_eval():
        seen = [model.measurement_cov(params, s, times[0]) for s in np.unique(sensors)]
        if any(checks.concrete_value(R) is None for R in seen):
            return True  # a model that was built inside a trace holds what is not known yet
        noise = np.concatenate([np.diag(np.asarray(R)) for R in seen]).min()
        gap = np.diff(times, prepend=float(t0)).max()
        if not np.diag(cov).max() * max(1.0, gap) ** 2 * eps > LIMIT / 10 * noise:
            return True  # a look without a program of its own: most priors are far from the limit
        stamps = np.append(float(t0), times).astype(dtype)
        mean = jnp.asarray(prior.mean, dtype)
        matrices = _matrices_along(model, params, mean, stamps[:-1], stamps[1:], sensors)
    if any(checks.concrete_value(x) is None for x in matrices):
        return True
    share = _rounding_share(cov, [np.asarray(x, float) for x in matrices], eps)
    checks.require(
        share <= LIMIT,
        "prior.cov",
        f"variances that a covariance in {jnp.dtype(dtype).name} can hold beside the measurements' "
        "(about 1e6 times R in float32; use square_root or information, ewif with prior=None, "
        "or float64)",
        f"variances up to {np.diag(cov).max():.3g}, of which rounding alone is {share:.2g} times "
        "what the first measurements leave",
    )
    return True


@partial(jax.jit, static_argnames="model")
def _matrices_along(
    model: Model, params: Params, mean: Array, start: Array, end: Array, sensors: Array
) -> tuple[Array, ...]:
    """F, Q, H and R of each interval and the measurement after it, along the predicted mean."""

    def row(mean: Array, given: tuple[Array, Array, Array]) -> tuple[Array, tuple[Array, ...]]:
        before, time, sensor = given
        mean, F, Q = predict_state(model, params, mean, before, time)
        _, H, R = predict_measurement(model, params, mean, sensor, time)
        return mean, (dense(F), Q, dense(H), R)

    return jax.lax.scan(row, mean, (start, end, sensors))[1]


def _rounding_share(cov: np.ndarray, rows: list[np.ndarray], eps: float) -> float:
    """The largest share of a variance after an update that is what the covariance before it was
    rounded by: (I - K H) dP (I - K H)' with |dP_ij| = eps sqrt(P_ii P_jj)."""
    share = 0.0
    for F, Q, H, R in zip(*rows, strict=True):
        cov = F @ cov @ F.T + Q
        K = cov @ H.T @ np.linalg.pinv(H @ cov @ H.T + R, hermitian=True)
        kept = np.eye(len(cov)) - K @ H
        before = np.sqrt(np.diag(cov).clip(0))
        cov = kept @ cov @ kept.T + K @ R @ K.T
        rounding, left = eps * np.square(np.abs(kept) @ before), np.diag(cov)
        # What is known exactly stays so: nothing to compare with.
        inexact = left > 1e-14 * np.square(before)
        share = max([share, *(rounding[inexact] / left[inexact])])
    return float(share)
