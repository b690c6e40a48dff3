"""What a late measurement is still worth: its gain in the ideal filter (Yoder et al. 2018)."""

import operator
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.analysis.riccati import dare, gain


def steady_state_gain(F: Any, H: Any, Q: Any, R: Any) -> Array:
    r"""The gain K (n, m) of the Kalman filter after many equal steps.

    .. math::
        K = C^p H' (H C^p H' + R)^{-1}, \quad
        C^p = F (C^p - C^p H' (H C^p H' + R)^{-1} H C^p) F' + Q \quad (3)

    Yoder et al., section 2.3. Differentiable in every argument, forward and reverse.

    Args:
        F, H, Q, R: (n, n), (m, n), (n, n), (m, m); plain numbers for a scalar system. Q may be
            singular.

    Returns:
        K, or NaN where the filter has no steady state (an undetectable growing mode).

    Raises:
        ValueError: wrong shapes; Q not PSD; R not positive definite.

    Reduces to: `random_walk_gain`, `alpha_beta_gains`.
    """
    F, H, Q, R = _system(F, H, Q, R)
    return gain(dare(F, H, Q, R), H, R)


def delayed_gain(F: Any, H: Any, Q: Any, R: Any, steps: Any) -> Array:
    r"""The gain (n, m) that the ideal filter gives to a measurement `steps` intervals old.

    .. math::
        K_n(T_d) = ((I - K H) F)^{T_d / \Delta T} K \quad (5)

    Args:
        F, H, Q, R: as in `steady_state_gain`.
        steps: T_d / dT >= 0. A Python integer is a product of matrices; any other number goes
            through the eigenvalues (principal branch, real part), which needs distinct ones.
    """
    F, H, Q, R = _system(F, H, Q, R)
    K = gain(dare(F, H, Q, R), H, R)
    checks.at_least("steps", steps, 0)
    loop = (jnp.eye(F.shape[0], dtype=F.dtype) - K @ H) @ F
    if isinstance(steps, int | np.integer):
        return jnp.linalg.matrix_power(loop, operator.index(steps)) @ K
    # the result does not depend on how eigenvectors are scaled, so their derivative is safe here
    values, vectors = lax.linalg.eig(
        loop, compute_left_eigenvectors=False, enable_eigvec_derivs=True
    )
    modes = jnp.linalg.solve(vectors, K.astype(vectors.dtype))
    return jnp.real(vectors @ (_power(values, steps)[:, None] * modes))


def cutoff_delay(F: Any, H: Any, Q: Any, R: Any, *, ratio: Any = 0.6, interval: Any = 1.0) -> Array:
    r"""The delay T_d () in seconds at which the gain has decayed to `ratio` of a fresh one's.

    .. math::
        T_d = \Delta T \frac{\log(k_{min} / k)}{\log \rho((I - K H) F)} \quad (8)

    The gain of more than one state may oscillate, so what is followed to `ratio` is its
    exponential envelope, whose rate is the spectral radius.

    Args:
        F, H, Q, R: as in `steady_state_gain`, over one interval between measurements.
        ratio: k_min / k in (0, 1).
        interval: mean time between measurements in seconds.

    Reduces to: eq. (8), `random_walk_cutoff`, for a scalar system.

    Deviations: the text after (8) keeps "T >= T_d"; T <= T_d is meant.
    """
    _fraction(ratio)
    F, H, Q, R = _system(F, H, Q, R)
    K = gain(dare(F, H, Q, R), H, R)
    values = jnp.linalg.eigvals((jnp.eye(F.shape[0], dtype=F.dtype) - K @ H) @ F)
    return interval * jnp.log(ratio) / jnp.log(jnp.max(jnp.abs(values)))


def maneuvering_index(
    q: Any, r: Any, interval: Any, motion: Literal["random_walk", "acceleration"] = "random_walk"
) -> Array:
    r"""The dimensionless ratio lambda () of motion to measurement noise.

    "random_walk": :math:`\sigma_Q \sqrt{\Delta T} / \sigma_R` for (6)-(8), q in m^2/s.
    "acceleration": :math:`\sigma_Q \Delta T^2 / \sigma_R` for (9)-(13), q in m^2/s^4.

    Args:
        q: process noise variance :math:`\sigma_Q^2`.
        r: measurement variance :math:`\sigma_R^2` in m^2.
        interval: time between measurements in seconds.
        motion: which of the two.
    """
    expected = "'random_walk' or 'acceleration'"
    checks.require(motion in ("random_walk", "acceleration"), "motion", expected, repr(motion))
    checks.at_least("q", q, 0.0)
    checks.positive("r", r)
    checks.at_least("interval", interval, 0.0)
    power = 0.5 if motion == "random_walk" else 2.0
    return jnp.sqrt(jnp.asarray(q) / r) * jnp.asarray(interval) ** power


def random_walk_gain(index: Any) -> Array:
    r"""The steady gain k () of a random walk.

    .. math::
        k = \tfrac12 (-\lambda^2 + \sqrt{\lambda^4 + 4 \lambda^2})
          = \frac{2 \lambda}{\lambda + \sqrt{\lambda^2 + 4}} \quad (6)

    The second form loses no digits for small or large lambda.

    Args:
        index: lambda >= 0 of `maneuvering_index`.
    """
    index = jnp.asarray(checks.at_least("index", index, 0.0))
    return 2 * index / (index + jnp.hypot(index, 2))


def random_walk_cutoff(index: Any, *, ratio: Any = 0.6, interval: Any = 1.0) -> Array:
    r"""T_d () in seconds of eq. (8) for a random walk, with
    :math:`\log(1 - k) = -2\,\mathrm{asinh}(\lambda / 2)`.

    Args:
        index: lambda > 0 of `maneuvering_index`.
        ratio: k_min / k in (0, 1).
        interval: mean time between measurements in seconds.
    """
    _fraction(ratio)
    index = jnp.asarray(checks.positive("index", index))
    return -interval * jnp.log(ratio) / (2 * jnp.arcsinh(index / 2))


def alpha_beta_gains(index: Any) -> tuple[Array, Array]:
    r"""alpha and beta () of the steady gain K = (alpha, beta / dT) for piecewise constant
    acceleration.

    .. math::
        \alpha &= \tfrac18 (-\lambda^2 - 8 \lambda + (\lambda + 4) \sqrt{\lambda^2 + 8 \lambda})
            = 1 - r^2 \quad (10) \\
        \beta &= \tfrac14 (\lambda^2 + 4 \lambda - \lambda \sqrt{\lambda^2 + 8 \lambda})
            = 2 (1 - r)^2 \quad (11)

    with :math:`r = 4 / (4 + \lambda + \sqrt{\lambda^2 + 8 \lambda})`, which loses no digits.

    Args:
        index: lambda >= 0 of `maneuvering_index(..., "acceleration")`.
    """
    index = jnp.asarray(checks.at_least("index", index, 0.0))
    travel = index + jnp.sqrt(index) * jnp.sqrt(index + 8)
    rest = travel / (4 + travel)
    return rest * (2 - rest), 2 * rest**2


def alpha_beta_eigenvalues(index: Any) -> Array:
    r"""The two eigenvalues (2,), complex, of (I - K H) F for `alpha_beta_gains`.

    .. math::
        1 - \frac{\alpha + \beta}{2} \pm \frac12 \sqrt{(\alpha + \beta)^2 - 4 \beta} \quad (13)

    They are a complex pair for every lambda < 8: the delayed gain then changes sign.
    """
    alpha, beta = alpha_beta_gains(index)
    half = (alpha + beta) / 2
    root = jnp.sqrt(lax.complex(half**2 - beta, jnp.zeros_like(beta)))
    return 1 - half + jnp.stack([root, -root])


class GainHistory(NamedTuple):
    """gain (T, L+1, n, m): gain[j, l] is the weight of measurement j - l in estimate j, zero where
    l > j; initial (T, n, n): the weight of the first prediction in estimate j."""

    gain: Array
    initial: Array


def gain_history(F: Any, H: Any, Q: Any, R: Any, first_cov: Any, lag: int) -> GainHistory:
    r"""The weights of the last `lag` + 1 measurements in every estimate of a Kalman filter.

    .. math::
        k_{j,0} = K_j, \quad k_{j,l} = (I - K_j H) F_{j-1} k_{j-1,l-1}

    Algorithm 1 of Yoder et al. for any dimension and any spacing of the measurements.

    Args:
        F, Q: (T-1, n, n), from measurement j to j + 1; for irregular times put each interval's in.
        H, R: (m, n), (m, m).
        first_cov: (n, n) predicted covariance at the first measurement.
        lag: how many earlier measurements to follow, >= 0.

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
    eye = jnp.eye(n, dtype=F.dtype)

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


def _power(values: Array, steps: Any) -> Array:
    """values^steps with 0^0 = 1 and 0^s = 0, finite gradients included."""
    zero = values == 0
    raised = jnp.exp(steps * jnp.log(jnp.where(zero, 1, values)))
    return jnp.where(zero, jnp.where(steps == 0, 1, 0), raised)


def _fraction(ratio: Any) -> None:
    value = checks.known(ratio)
    if value is not None:
        good = np.all((value > 0) & (value < 1))
        checks.require(good, "ratio", "a number between 0 and 1", ratio)


def _system(F: Any, H: Any, Q: Any, R: Any) -> tuple[Array, Array, Array, Array]:
    """The four matrices in one float dtype; numbers become (1, 1)."""
    matrices = [jnp.atleast_2d(jnp.asarray(x)) for x in (F, H, Q, R)]
    dtype = jnp.result_type(*matrices)
    dtype = dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.result_type(float)
    F, H, Q, R = (x.astype(dtype) for x in matrices)
    n, m = F.shape[0], H.shape[0]
    checks.shape("F", F, (n, n))
    checks.shape("H", H, (m, n))
    checks.shape("Q", Q, (n, n))
    checks.shape("R", R, (m, m))
    checks.psd("Q", Q)
    checks.psd("R", R, definite=True)
    return F, H, Q, R
