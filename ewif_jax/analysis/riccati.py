"""The steady state of the Kalman filter: a differentiable solution of its Riccati equation."""

import jax
import jax.numpy as jnp
from jax import Array, lax

DOUBLINGS = 64


def riccati_step(P: Array, F: Array, H: Array, Q: Array, R: Array) -> Array:
    """The predicted covariance (n, n) one step after the predicted covariance P."""
    K = gain(P, H, R)
    kept = jnp.eye(P.shape[0], dtype=P.dtype) - K @ H
    after = F @ (kept @ P @ kept.T + K @ R @ K.T) @ F.T + Q
    return (after + after.T) / 2


def gain(P: Array, H: Array, R: Array) -> Array:
    """K = P H' (H P H' + R)^-1, (n, m)."""
    return jnp.linalg.solve(H @ P @ H.T + R, H @ P).T


@jax.jit
def dare(F: Array, H: Array, Q: Array, R: Array) -> Array:
    r"""The steady predicted covariance P (n, n) of a detectable system; NaN where there is none.

    .. math::
        P = F (P - P H' (H P H' + R)^{-1} H P) F' + Q

    Eq. (3) of Yoder et al., by structure-preserving doubling (Chu, Fan, Lin & Wang 2004): step k
    of the iteration is step :math:`2^k` of the filter. Derivatives of either mode come from the
    implicit function theorem, so they do not depend on the iteration. Q may be singular; R is
    positive definite.
    """
    # The unknown is the upper triangle: half as many numbers in the linear system of the
    # derivative.
    rows, cols = jnp.triu_indices(F.shape[0])

    def full(packed: Array) -> Array:
        square = jnp.zeros(F.shape, packed.dtype).at[rows, cols].set(packed)
        return square.at[cols, rows].set(packed)

    def defect(packed: Array) -> Array:
        return riccati_step(full(packed), F, H, Q, R)[rows, cols] - packed

    def solve(_: object, guess: Array) -> Array:
        del guess
        return _doubled_solution(F, H, Q, R)[rows, cols]

    # The defect is linear in the tangent, so its Jacobian is one small matrix (n (n + 1) / 2):
    # solved directly, where an iteration would need a rate of its own.
    def tangent_solve(linear: object, y: Array) -> Array:
        return jnp.linalg.solve(jax.jacfwd(linear)(jnp.zeros_like(y)), y)  # type: ignore[arg-type]

    return full(lax.custom_root(defect, Q[rows, cols], solve, tangent_solve))


def _doubled_solution(F: Array, H: Array, Q: Array, R: Array) -> Array:
    eye = jnp.eye(F.shape[0], dtype=F.dtype)
    tolerance = 4 * F.shape[0] * float(jnp.finfo(F.dtype).eps)

    def going(carry: tuple[Array, ...]) -> Array:
        count, change, _, _, P = carry
        return (count < DOUBLINGS) & (change > tolerance * jnp.max(jnp.abs(P)))

    def double(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        count, _, A, G, P = carry
        # Structure-preserving doubling: A, G, P of 2^k steps give those of 2^(k+1) with one
        # factorisation, A (I + G P)^-1 A and so on (Chu, Fan, Lin & Wang 2004, SDA).
        lu = jax.scipy.linalg.lu_factor(eye + G @ P)
        solved_A = jax.scipy.linalg.lu_solve(lu, A)
        G_next = G + A @ jax.scipy.linalg.lu_solve(lu, G) @ A.T
        P_next = P + A.T @ P @ solved_A
        P_next = (P_next + P_next.T) / 2
        change = jnp.max(jnp.abs(P_next - P))
        return count + 1, change, A @ solved_A, (G_next + G_next.T) / 2, P_next

    G = H.T @ jnp.linalg.solve(R, H)
    start = (jnp.zeros((), jnp.int32), jnp.full((), jnp.inf, F.dtype), F.T, (G + G.T) / 2, Q)
    _, change, _, _, P = lax.while_loop(going, double, start)
    steady = change <= tolerance * jnp.max(jnp.abs(P))
    return jnp.where(steady, P, jnp.nan)
