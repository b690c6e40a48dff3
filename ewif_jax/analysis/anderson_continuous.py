"""What exponential data weighting does to a continuous filter: Anderson (1973), section 4."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.analysis.stabilising import continuous_lyapunov, stabilising_care
from ewif_jax.analysis.stability import require_steady_state
from ewif_jax.streams import float_dtype
from ewif_jax.types import Numbers, Params


class ContinuousSystem(NamedTuple):
    """dx = F x dt + G dw, z = H x + v: F (n, n), G (n, p), H (m, n), and the spectral densities
    Q (p, p) of the input and R (m, m) of the measurement noise. Anderson's H' is H here.

    For `kalman_bucy` each may be a function (params, t).
    """

    F: Array
    G: Array
    H: Array
    Q: Array
    R: Array


class ContinuousSteadyState(NamedTuple):
    """cov: Pi, error: E (n, n), gain (n, m), closed_loop: F - K H (n, n)."""

    cov: Array
    error: Array
    gain: Array
    closed_loop: Array


def steady_state_continuous(
    system: ContinuousSystem,
    *,
    fading_rate: Array = 0.0,  # type: ignore[assignment]
) -> ContinuousSteadyState:
    r"""The stationary weighted Kalman-Bucy filter of a constant system, and its actual error.

    .. math::
        0 &= \Pi (F' + \alpha I) + (F + \alpha I) \Pi - \Pi H' R^{-1} H \Pi + G Q G'
            \quad (4\text{-}2) \\
        0 &= (F - K H) \mathcal E + \mathcal E (F - K H)' + G Q G' + K R K'
            \quad (4\text{-}10), \quad K = \Pi H' R^{-1}

    All eigenvalues of F - K H have real parts of at most :math:`-\alpha`. Differentiable in the
    matrices and in alpha, by the implicit function theorem.

    Args:
        system: constant matrices.
        fading_rate: alpha >= 0 in 1/s; 1 / (2 tau) with Q = 0 gives the EWIF's limit.

    Raises:
        ValueError: fading_rate < 0; there is no such state: a mode that does not decay is not
            seen, or a mode that neither grows nor decays is not driven; wrong shapes, Q not PSD, R
            not positive definite.
    """
    checks.at_least("fading_rate", fading_rate, 0.0)
    checks.shape("fading_rate", fading_rate, ())
    check_continuous("system", system)
    F, G, H, Q, R = (jnp.asarray(x, float_dtype(system[0])) for x in system)
    noise = G @ Q @ G.T
    weighted = F + jnp.asarray(fading_rate, F.dtype) * jnp.eye(F.shape[0], dtype=F.dtype)
    require_steady_state(weighted, H, noise, on_edge=np.real)
    return _steady_state(F, weighted, H, noise, R)


@jax.jit
def _steady_state(
    F: Array, weighted: Array, H: Array, noise: Array, R: Array
) -> ContinuousSteadyState:
    cov = stabilising_care(weighted, H, noise, R)
    K = jnp.linalg.solve(R, H @ cov).T
    closed_loop = F - K @ H
    error = continuous_lyapunov(closed_loop, noise + K @ R @ K.T)
    return ContinuousSteadyState(cov, error, K, closed_loop)


def weighting_as_input_noise(noise: Array, cov: Array, fading_rate: Array) -> Array:
    r"""The input noise (n, n) with which a filter *without* weighting has the same gains.

    .. math:: G Q G' + 2 \alpha \Pi_\alpha \quad (4\text{-}7)

    Args:
        noise: G Q G' (n, n).
        cov: Pi (n, n) at the same time.
        fading_rate: alpha in 1/s, ().

    Raises:
        ValueError: wrong shapes; noise or cov not PSD; fading_rate < 0.

    Deviations: the first terms of (4-7) are printed as Pi F + F' Pi for Pi F' + F Pi, and the text
        after it says measurement noise for input noise.

    See also: `weighting_as_process_noise`, the same in discrete time. `equivalent_process_noise` is
    another question: the noise with which a Kalman filter behaves like an EWIF.
    """
    checks.at_least("fading_rate", fading_rate, 0.0)
    checks.shape("cov", cov, ("n", "n"))
    checks.shape("noise", noise, np.shape(cov))
    checks.psd("noise", noise)
    checks.psd("cov", cov)
    noise, cov = jnp.asarray(noise), jnp.asarray(cov)
    return noise + 2 * fading_rate * cov


def check_continuous(
    name: str,
    system: ContinuousSystem,
    n: Numbers = None,
    m: Numbers = "m",
    *,
    params: Params = None,
    start: Numbers = None,
) -> None:
    """Refuses matrices of a system of n states and m measurements that do not fit each other, are
    not finite, or are no densities; functions of time are looked at at `start` (None: refused)."""
    ok = isinstance(system, tuple) and len(system) == 5
    checks.require(ok, name, "a ContinuousSystem(F, G, H, Q, R)", type(system).__name__)
    at = {}
    for field, x in zip(ContinuousSystem._fields, system, strict=True):
        constant = start is not None or not callable(x)
        checks.require(constant, f"{name}.{field}", "a constant matrix", "a function")
        at[field] = x(params, start) if callable(x) else x
        checks.shape(f"{name}.{field}", at[field], (".", "."))
        checks.finite(f"{name}.{field}", at[field])
    n = np.shape(at["F"])[0] if n is None else n
    m = np.shape(at["H"])[0] if m == "m" else m
    p = np.shape(at["G"])[1]
    shapes = {"F": (n, n), "G": (n, p), "H": (m, n), "Q": (p, p), "R": (m, m)}
    for field, shape in shapes.items():
        checks.shape(f"{name}.{field}", at[field], shape)
    checks.psd(f"{name}.Q", at["Q"])
    checks.psd(f"{name}.R", at["R"], definite=True)
