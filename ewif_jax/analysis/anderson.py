"""What exponential data weighting does to a discrete filter: Anderson (1973), section 5."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.analysis.riccati import gain
from ewif_jax.analysis.stabilising import discrete_lyapunov, stabilising_dare
from ewif_jax.analysis.stability import require_steady_state
from ewif_jax.streams import float_dtype
from ewif_jax.types import Numbers


class System(NamedTuple):
    """x(k) = F x(k-1) + w, z(k) = H x(k) + v: F (n, n), H (m, n), Q = cov w (n, n), R = cov v
    (m, m); each constant, or stacked (T, ...) with entry k for the step into measurement k.

    Anderson's H' is H here, and his G Q G' is Q.
    """

    F: Array
    H: Array
    Q: Array
    R: Array


class Weighted(NamedTuple):
    """The covariances a filter computes: predicted (T, n, n), cov (T, n, n), gain (T, n, m)."""

    predicted: Array
    cov: Array
    gain: Array


class Bounds(NamedTuple):
    """best <= error <= design (5-18), each (T, n, n): what the optimal filter achieves, what the
    weighted one achieves, and what the weighted one believes."""

    best: Array
    error: Array
    design: Array


class SteadyState(NamedTuple):
    """predicted, cov, error (n, n), gain (n, m), closed_loop (n, n): the matrix F (I - K H) by
    which an error is carried from step to step."""

    predicted: Array
    cov: Array
    error: Array
    gain: Array
    closed_loop: Array


def weighted_covariances(system: System, cov0: Array, *, fading: Array, steps: int) -> Weighted:
    r"""The covariances and gains of the exponentially weighted filter, without data.

    .. math::
        \hat\Pi(k) &= \alpha^2 F \Pi(k-1) F' + Q \quad (5\text{-}14) \\
        K(k) &= \hat\Pi H' (H \hat\Pi H' + R)^{-1} \quad (5\text{-}13) \\
        \Pi(k) &= (I - K H) \hat\Pi (I - K H)' + K R K' \quad (5\text{-}15)

    Args:
        system: what the filter is designed for.
        cov0: Pi(k0) = P0 (n, n).
        fading: alpha >= 1, () or (T,).
        steps: T.

    Raises:
        ValueError: wrong shapes; cov0, Q or R not PSD; fading < 1; steps < 1.

    Reduces to: the Kalman filter for alpha = 1.
    """
    checks.at_least("fading", fading, 1.0)
    steps = checks.whole("steps", steps, 1)
    if np.ndim(fading):
        checks.shape("fading", fading, (steps,))
    checks.shape("cov0", cov0, ("n", "n"))
    checks.psd("cov0", cov0)
    check_system("system", system, np.shape(cov0)[:1], steps)
    return _weighted_covariances(system, _as_floats(cov0), fading, steps)


@partial(jax.jit, static_argnames="steps")
def _weighted_covariances(system: System, cov0: Array, fading: Array, steps: int) -> Weighted:
    def body(cov: Array, step: tuple[System, Array]) -> tuple[Array, Weighted]:
        (F, H, Q, R), alpha = step
        predicted = _made_symmetric(alpha**2 * F @ cov @ F.T + Q)
        K = gain(predicted, H, R)
        cov = _updated_cov(predicted, K, H, R)
        return cov, Weighted(predicted, cov, K)

    alphas = jnp.broadcast_to(jnp.asarray(fading, cov0.dtype), (steps,))
    return lax.scan(body, cov0, (_stacked_system(system, steps), alphas))[1]


def actual_error(
    gain: Array,
    system: System,
    cov0: Array,
    *,
    design: System | None = None,
    mean0: Array | None = None,
) -> Array:
    r"""The actual mean square error E (T, n, n) after each update with the given gains.

    .. math::
        \hat{\mathcal E}(k) &= F \mathcal E(k-1) F' + Q \quad (5\text{-}19) \\
        \mathcal E(k) &= (I - K H) \hat{\mathcal E} (I - K H)' + K R K' \quad (5\text{-}20)

    Args:
        gain: K (T, n, m), of whatever filter.
        system: the true system.
        cov0: covariance (n, n) of the true initial state around the filter's.
        design: the system whose F and H the filter uses, if not the true ones. The error then
            depends on the state itself, so the second moments of state and error are carried.
        mean0: true mean of the initial state (n,), default 0; it matters with a `design` only, the
            estimate being assumed to start there.

    Raises:
        ValueError: wrong shapes; cov0, Q or R not PSD.

    Reduces to: (5-19), (5-20) for a design with the true F and H.

    Deviations: the second bracket of (5-20) is printed without its transpose.
    """
    checks.shape("gain", gain, ("T", "n", "m"))
    steps, n, m = np.shape(gain)
    checks.shape("cov0", cov0, (n, n))
    checks.psd("cov0", cov0)
    check_system("system", system, (n,), steps, m)
    if design is not None:
        check_system("design", design, (n,), steps, m)
    if mean0 is not None:
        checks.shape("mean0", mean0, (n,))
    return _actual_error(_as_floats(gain), system, _as_floats(cov0), design, mean0)


@jax.jit
def _actual_error(
    gain: Array, system: System, cov0: Array, design: System | None, mean0: Array | None
) -> Array:
    steps, n = gain.shape[:2]
    truth = _stacked_system(system, steps)
    if design is None:

        def body(E: Array, step: tuple[System, Array]) -> tuple[Array, Array]:
            (F, H, Q, R), K = step
            E = _updated_cov(F @ E @ F.T + Q, K, H, R)
            return E, E

        return lax.scan(body, cov0, (truth, gain))[1]
    mean = jnp.zeros(n, cov0.dtype) if mean0 is None else jnp.asarray(mean0)
    # Second moments of (x, e) at the start: E[x x'] = P0 + m m', and e = x - m.
    moments = jnp.block([[cov0 + jnp.outer(mean, mean), cov0], [cov0, cov0]])
    eye = jnp.eye(n, dtype=cov0.dtype)

    def both(S: Array, step: tuple[System, System, Array]) -> tuple[Array, Array]:
        (F, H, Q, R), (F_used, H_used, _, _), K = step
        left, kept = eye - K @ H, (eye - K @ H_used) @ F_used
        # e+ = (I - K H) (F x + w) - (I - K H_d) F_d (x - e) - K v: the block under F is what the
        # design gets wrong of the state, and vanishes where both systems agree
        # (docs/decisions/analysis.md).
        move = jnp.block([[F, jnp.zeros_like(F)], [left @ F - kept, kept]])
        noise = jnp.block([[Q, Q @ left.T], [left @ Q, left @ Q @ left.T + K @ R @ K.T]])
        S = _made_symmetric(move @ S @ move.T + noise)
        return S, S[n:, n:]

    return lax.scan(both, moments, (truth, _stacked_system(design, steps), gain))[1]


def error_bounds(system: System, cov0: Array, *, fading: Array, steps: int) -> Bounds:
    r"""The bounds :math:`P(k) \le \mathcal E(k) \le \Pi_\alpha(k)` (5-18), all three.

    Arguments and errors as in `weighted_covariances`.

    Reduces to: three equal covariances for alpha = 1.
    """
    design = weighted_covariances(system, cov0, fading=fading, steps=steps)
    best = weighted_covariances(system, cov0, fading=jnp.ones(()), steps=steps).cov
    return Bounds(best, actual_error(design.gain, system, cov0), design.cov)


def weighting_as_process_noise(F: Array, Q: Array, cov: Array, fading: Array) -> Array:
    r"""The process noise (n, n) with which a filter *without* weighting has the same gains.

    .. math:: Q + (\alpha^2 - 1) F(k-1) \Pi_\alpha(k-1) F'(k-1) \quad (5\text{-}16)

    Args:
        F, Q: of the step into k, (n, n).
        cov: Pi(k-1), (n, n): known only once the weighted filter has been designed.
        fading: alpha, ().

    Raises:
        ValueError: wrong shapes; Q or cov not PSD; fading < 1.

    Deviations: (5-16) prints Pi(k) for Pi(k-1).

    See also: `weighting_as_input_noise`, the same in continuous time. `equivalent_process_noise` is
    another question: the noise with which a Kalman filter behaves like an EWIF.
    """
    checks.at_least("fading", fading, 1.0)
    checks.shape("F", F, ("n", "n"))
    for name, x in (("Q", Q), ("cov", cov)):
        checks.shape(name, x, np.shape(F))
        checks.psd(name, x)
    F, Q = jnp.asarray(F), jnp.asarray(Q)
    return Q + (jnp.square(fading) - 1) * (F @ jnp.asarray(cov) @ F.T)


def steady_state(system: System, *, fading: Array = 1.0) -> SteadyState:  # type: ignore[assignment]
    r"""The stationary weighted filter of a constant system, and its actual error.

    :math:`\hat\Pi` solves the Riccati equation with :math:`\alpha F` in the place of F; the error
    is the stationary solution of (5-19)-(5-20). Every eigenvalue of the closed loop lies within
    :math:`1/\alpha`. Differentiable in the matrices and in `fading`, by the implicit function
    theorem. `fading` = exp(dt / 2 tau) with Q = 0 gives the EWIF's.

    Raises:
        ValueError: fading < 1; there is no such state: a mode that does not decay is not seen, or
            a mode that neither grows nor decays is not driven; wrong shapes, Q not PSD, R not
            positive definite.
    """
    checks.at_least("fading", fading, 1.0)
    checks.shape("fading", fading, ())
    check_system("system", system, np.shape(system[0])[:1])
    checks.psd("system.R", system[3], definite=True)
    F, H, Q, R = (_as_floats(x) for x in system)
    weighted = jnp.asarray(fading, F.dtype) * F
    require_steady_state(weighted, H, Q, on_edge=lambda values: np.abs(values) - 1)
    return _steady_state(System(F, H, Q, R), weighted)


@jax.jit
def _steady_state(system: System, weighted: Array) -> SteadyState:
    F, H, Q, R = system
    predicted = stabilising_dare(weighted, H, Q, R)
    K = gain(predicted, H, R)
    left = jnp.eye(F.shape[0], dtype=F.dtype) - K @ H
    error = discrete_lyapunov(left @ F, left @ Q @ left.T + K @ R @ K.T)
    return SteadyState(predicted, _updated_cov(predicted, K, H, R), error, K, F @ left)


def check_system(
    name: str, system: System, n: tuple[int, ...], steps: int | None = None, m: Numbers = "m"
) -> None:
    """Refuses matrices of a system of n states that do not fit each other, are not finite, or are
    no covariances; `steps` is the length of those that are stacked (None: none may be)."""
    ok = isinstance(system, tuple) and len(system) == 4
    checks.require(ok, name, "a System(F, H, Q, R)", type(system).__name__)
    system = System(*system)
    if m == "m":
        m = np.shape(system.H)[-2] if np.ndim(system.H) > 1 else m
    shapes = {"F": (*n, *n), "H": (m, *n), "Q": (*n, *n), "R": (m, m)}
    for (field, x), shape in zip(system._asdict().items(), shapes.values(), strict=True):
        label = f"{name}.{field}"
        stacked = steps is not None and np.ndim(x) == 3
        checks.shape(label, x, (steps, *shape) if stacked else shape)  # type: ignore[arg-type]
        checks.finite(label, x)
        value = checks.concrete_value(x)
        if field in "QR" and value is not None:
            for k, one in enumerate(value if stacked else [value]):
                checks.psd(f"{label}[{k}]" if stacked else label, one)


def _as_floats(x: Numbers) -> Array:
    x = jnp.asarray(x)
    return x.astype(float_dtype(x))


def _updated_cov(predicted: Array, K: Array, H: Array, R: Array) -> Array:
    left = jnp.eye(K.shape[0], dtype=K.dtype) - K @ H
    return _made_symmetric(left @ predicted @ left.T + K @ R @ K.T)


def _made_symmetric(x: Array) -> Array:
    return (x + x.T) / 2


def _stacked_system(system: System, steps: int) -> System:
    """Every matrix stacked (T, ...)."""
    arrays = (jnp.asarray(x) for x in system)
    return System(*(x if x.ndim == 3 else jnp.broadcast_to(x, (steps, *x.shape)) for x in arrays))
