"""The weights of past measurements in every estimate of a Kalman filter (Yoder et al. 2018)."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.analysis.riccati import gain
from ewif_jax.types import Numbers


class GainHistory(NamedTuple):
    """gain (T, L+1, n, m): gain[j, l] is the weight of measurement j - l in estimate j, zero where
    l > j; initial (T, n, n): the weight of the first prediction in estimate j."""

    gain: Array
    initial: Array


def gain_history(
    F: Numbers, H: Numbers, Q: Numbers, R: Numbers, first_cov: Numbers, lag: int
) -> GainHistory:
    r"""The weights of the last `lag` + 1 measurements in every estimate of a Kalman filter.

    .. math::
        k_{j,0} = K_j, \quad k_{j,l} = (I - K_j H) F_{j-1} k_{j-1,l-1}

    Algorithm 1 of Yoder et al. for any dimension and any spacing of the measurements.

    Args:
        F, Q: (T-1, n, n), from measurement j to j + 1; for irregular times put each interval's in.
        H, R: (m, n), (m, m).
        first_cov: (n, n) predicted covariance at the first measurement.
        lag: how many earlier measurements to follow, >= 0.

    Raises:
        ValueError: wrong shapes; numbers that are not finite; first_cov or a Q not PSD; R not
            positive definite; lag < 0.

    Reduces to: `delayed_gain` for equal intervals after many steps.

    Deviations: as printed k(j,0) lacks h, the gains are shifted by the wrong index, and c^p(1) is
        not given.
    """
    lag = checks.whole("lag", lag, 0)
    F, H, Q, R, cov = (jnp.asarray(x, jnp.result_type(float, F)) for x in (F, H, Q, R, first_cov))
    checks.shape("F", F, ("T-1", "n", "n"))
    n, m = F.shape[1], H.shape[0]
    checks.shape("Q", Q, F.shape)
    checks.shape("H", H, ("m", n))
    checks.shape("R", R, (m, m))
    checks.shape("first_cov", cov, (n, n))
    checks.finite("F", F)
    checks.finite("H", H)
    for k, one in enumerate(() if checks.concrete_value(Q) is None else np.asarray(Q)):
        checks.psd(f"Q[{k}]", one)
    checks.psd("R", R, definite=True)
    checks.psd("first_cov", cov)
    return _gains_along(F, H, Q, R, cov, lag)


@partial(jax.jit, static_argnames="lag")
def _gains_along(F: Array, H: Array, Q: Array, R: Array, cov: Array, lag: int) -> GainHistory:
    m, n = H.shape
    eye = jnp.eye(n, dtype=F.dtype)

    # The weights of all earlier measurements move alike, by (I - K H) F: one product for all, and
    # no power of a matrix is formed.
    def body(carry: tuple, motion: tuple[Array, Array]) -> tuple[tuple, GainHistory]:
        cov, gains, initial = carry
        K = gain(cov, H, R)
        kept = eye - K @ H
        gains = jnp.concatenate([K[None], jnp.einsum("ij,ljm->lim", kept, gains[:-1])])
        found = GainHistory(gains, kept @ initial)
        F, Q = motion
        cov = F @ (kept @ cov @ kept.T + K @ R @ K.T) @ F.T + Q
        return (cov, jnp.einsum("ij,ljm->lim", F, gains), F @ found.initial), found

    still = (jnp.concatenate([F, eye[None]]), jnp.concatenate([Q, jnp.zeros_like(eye)[None]]))
    start = (cov, jnp.zeros((lag + 1, n, m), F.dtype), eye)
    return lax.scan(body, start, still)[1]
