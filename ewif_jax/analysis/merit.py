"""What a late measurement is still worth: its gain in the ideal filter (Yoder et al. 2018)."""

import operator
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.analysis.powers import last_time_above, real_power
from ewif_jax.analysis.riccati import gain
from ewif_jax.analysis.stabilising import check_seen_noise, predicted_dare
from ewif_jax.types import Numbers


def steady_state_gain(F: Numbers, H: Numbers, Q: Numbers, R: Numbers) -> Array:
    r"""The gain K (n, m) of the Kalman filter after many equal steps.

    .. math::
        K = C^p H' (H C^p H' + R)^{-1}, \quad
        C^p = F (C^p - C^p H' (H C^p H' + R)^{-1} H C^p) F' + Q \quad (3)

    Yoder et al., section 2.3. Of several solutions it is the one that the filter reaches from any
    positive definite covariance: a growing mode is followed, whether noise drives it or not.
    Differentiable in every argument, forward and reverse.

    Args:
        F, H, Q, R: (n, n), (m, n), (n, n), (m, m); plain numbers for a scalar system. Q may be
            singular, and R too (an exact measurement) where R + H Q H' is not.

    Returns:
        K, or NaN where the filter has no steady state (a mode that does not decay and is not seen).
        K has no derivative where a mode neither grows nor decays and no noise drives it.

    Raises:
        ValueError: wrong shapes; Q or R not PSD; R and R + H Q H' not positive definite.

    Reduces to: `random_walk_gain`, `alpha_beta_gains`.
    """
    return _steady_gain(*_checked_system(F, H, Q, R))


def delayed_gain(F: Numbers, H: Numbers, Q: Numbers, R: Numbers, steps: Numbers) -> Array:
    r"""The gain (n, m) that the ideal filter gives to a measurement `steps` intervals old.

    .. math::
        K_n(T_d) = ((I - K H) F)^{T_d / \Delta T} K \quad (5)

    Args:
        F, H, Q, R: as in `steady_state_gain`.
        steps: T_d / dT >= 0. A Python integer is a product of matrices; any other number goes
            through the eigenvectors (principal branch, real part).

    Raises:
        ValueError: as `steady_state_gain`; steps < 0 or not a single number.

    Reduces to: `steady_state_gain` at 0; eq. (7) for a random walk.
    """
    system = _checked_system(F, H, Q, R)
    checks.at_least("steps", steps, 0)
    checks.shape("steps", steps, ())
    if isinstance(steps, int | np.integer):
        K, loop = _steady_loop(*system)
        return jnp.linalg.matrix_power(loop, operator.index(steps)) @ K
    return _gain_after(*system, jnp.asarray(steps, system[0].dtype))


def cutoff_delay(
    F: Numbers, H: Numbers, Q: Numbers, R: Numbers, *, ratio: Numbers = 0.6, interval: Numbers = 1.0
) -> Array:
    r"""The delay T_d () in seconds from which on the gain stays below `ratio` of a fresh one's.

    .. math::
        T_d = \max \{ T : \| K_n(T) \| \ge \mathrm{ratio} \, \| K_n(0) \| \}, \quad
        K_n(T) = ((I - K H) F)^{T / \Delta T} K

    The gain of more than one state may oscillate and swell before it fades, so the last crossing
    counts. The norm is Frobenius', in the units of the state: scale the state to weigh its
    components. For a scalar system this is

    .. math::
        T_d = \Delta T \, \frac{\log(k_{min} / k)}{\log((1 - k h) f)} \quad (8)

    Differentiable, where the crossing is not a touch.

    Args:
        F, H, Q, R: as in `steady_state_gain`, over one interval between measurements.
        ratio: k_min / k in (0, 1).
        interval: mean time between measurements in seconds.

    Returns:
        T_d >= 0; inf where the gain does not decay (a mode that neither grows nor decays and is
        not driven); NaN where there is no gain to compare with: no steady state, or K = 0.

    Raises:
        ValueError: as `steady_state_gain`; ratio outside (0, 1); interval <= 0.

    Reduces to: eq. (8), `random_walk_cutoff`, for a scalar system.

    Deviations: (8) is for one state; here any number, by the norm. The text after (8) keeps
        "T >= T_d"; T <= T_d is meant.
    """
    _check_ratio(ratio)
    checks.positive("interval", interval)
    system = _checked_system(F, H, Q, R)
    return interval * _cutoff_steps(*system, jnp.asarray(ratio, system[0].dtype))


def maneuvering_index(
    q: Numbers,
    r: Numbers,
    interval: Numbers,
    motion: Literal["random_walk", "acceleration"] = "random_walk",
) -> Array:
    r"""The dimensionless ratio lambda () of motion to measurement noise.

    "random_walk": :math:`\sigma_Q \sqrt{\Delta T} / \sigma_R` for (6)-(8), q in m^2/s.
    "acceleration": :math:`\sigma_Q \Delta T^2 / \sigma_R` for (9)-(13), q in m^2/s^4.

    Args:
        q: process noise variance :math:`\sigma_Q^2`.
        r: measurement variance :math:`\sigma_R^2` in m^2.
        interval: time between measurements in seconds.
        motion: which of the two.

    Raises:
        ValueError: q < 0; r <= 0; interval < 0; an unknown motion.
    """
    expected = "'random_walk' or 'acceleration'"
    checks.require(motion in ("random_walk", "acceleration"), "motion", expected, repr(motion))
    checks.at_least("q", q, 0.0)
    checks.positive("r", r)
    checks.at_least("interval", interval, 0.0)
    power = 0.5 if motion == "random_walk" else 2.0
    return jnp.sqrt(jnp.asarray(q) / r) * jnp.asarray(interval) ** power


def random_walk_gain(index: Numbers) -> Array:
    r"""The steady gain k () of a random walk.

    .. math::
        k = \tfrac12 (-\lambda^2 + \sqrt{\lambda^4 + 4 \lambda^2})
          = \frac{2 \lambda}{\lambda + \sqrt{\lambda^2 + 4}} \quad (6)

    The second form loses no digits for small or large lambda.

    Args:
        index: lambda >= 0 of `maneuvering_index`.

    Raises:
        ValueError: index < 0.
    """
    index = jnp.asarray(checks.at_least("index", index, 0.0))
    return 2 * index / (index + jnp.hypot(index, 2))


def random_walk_cutoff(index: Numbers, *, ratio: Numbers = 0.6, interval: Numbers = 1.0) -> Array:
    r"""T_d () in seconds of eq. (8) for a random walk, with
    :math:`\log(1 - k) = -2\,\mathrm{asinh}(\lambda / 2)`.

    Args:
        index: lambda > 0 of `maneuvering_index`.
        ratio: k_min / k in (0, 1).
        interval: mean time between measurements in seconds.

    Raises:
        ValueError: index <= 0; ratio outside (0, 1); interval <= 0.
    """
    _check_ratio(ratio)
    checks.positive("interval", interval)
    index = jnp.asarray(checks.positive("index", index))
    return -interval * jnp.log(ratio) / (2 * jnp.arcsinh(index / 2))


def alpha_beta_gains(index: Numbers) -> tuple[Array, Array]:
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

    Raises:
        ValueError: index < 0.
    """
    index = jnp.asarray(checks.at_least("index", index, 0.0))
    # Two roots, not the root of lambda^2 + 8 lambda: the square of a large lambda would overflow.
    travel = index + jnp.sqrt(index) * jnp.sqrt(index + 8)
    rest = travel / (4 + travel)
    return rest * (2 - rest), 2 * rest**2


def alpha_beta_eigenvalues(index: Numbers) -> Array:
    r"""The two eigenvalues (2,), complex, of (I - K H) F for `alpha_beta_gains`.

    .. math::
        1 - \frac{\alpha + \beta}{2} \pm \frac12 \sqrt{(\alpha + \beta)^2 - 4 \beta} \quad (13)

    They are a complex pair for every lambda < 8: the delayed gain then changes sign.

    Raises:
        ValueError: index < 0.
    """
    alpha, beta = alpha_beta_gains(index)
    half = (alpha + beta) / 2
    root = jnp.sqrt(lax.complex(half**2 - beta, jnp.zeros_like(beta)))
    return 1 - half + jnp.stack([root, -root])


@jax.jit
def _steady_gain(F: Array, H: Array, Q: Array, R: Array) -> Array:
    return gain(predicted_dare(F, H, Q, R), H, R)


@jax.jit
def _steady_loop(F: Array, H: Array, Q: Array, R: Array) -> tuple[Array, Array]:
    """K, and (I - K H) F."""
    K = gain(predicted_dare(F, H, Q, R), H, R)
    return K, (jnp.eye(F.shape[0], dtype=F.dtype) - K @ H) @ F


@jax.jit
def _gain_after(F: Array, H: Array, Q: Array, R: Array, steps: Array) -> Array:
    K, loop = _steady_loop(F, H, Q, R)
    return real_power(loop, steps) @ K


@jax.jit
def _cutoff_steps(F: Array, H: Array, Q: Array, R: Array, ratio: Array) -> Array:
    K, loop = _steady_loop(F, H, Q, R)
    return last_time_above(loop, K, ratio)


def _check_ratio(ratio: Numbers) -> None:
    value = checks.concrete_value(ratio)
    if value is not None:
        good = np.all((value > 0) & (value < 1))
        checks.require(good, "ratio", "a number between 0 and 1", ratio)


def _checked_system(
    F: Numbers, H: Numbers, Q: Numbers, R: Numbers
) -> tuple[Array, Array, Array, Array]:
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
    checks.finite("F", F)
    checks.finite("H", H)
    checks.psd("Q", Q)
    checks.psd("R", R)
    check_seen_noise(H, Q, R)
    return F, H, Q, R
