"""Stabilising solutions of Riccati equations, also where no noise drives a growing mode.

With exponential weighting and little or no process noise the equation has several solutions, and
an iteration from Q finds the smallest, which may be zero. Here a filter that is certainly stable
(designed with more noise) comes first, and Newton's method leads from it to the wanted solution.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.analysis.riccati import dare, gain, riccati_step
from ewif_jax.kernels import cholesky

NEWTON_STEPS = 60


def stabilising_dare(F: Array, H: Array, Q: Array, R: Array) -> Array:
    r"""The solution P (n, n) whose filter is stable; NaN where there is none.

    .. math::
        P = F (P - P H' (H P H' + R)^{-1} H P) F' + Q

    Newton's method (Hewer 1971). Derivatives come from the implicit function theorem.
    """

    def guess(Q: Array) -> Array:
        return dare(F, H, Q, R)

    def refined(P: Array) -> Array:
        FK = F @ gain(P, H, R)
        return discrete_lyapunov(F - FK @ H, FK @ R @ FK.T + Q)

    def defect(P: Array) -> Array:
        return riccati_step(P, F, H, Q, R) - P

    return _refined_root(defect, guess, refined, Q)


def strong_dare(F: Array, H: Array, Q: Array, R: Array) -> Array:
    r"""The solution P (n, n) that the filter reaches from any positive definite covariance.

    It is the stabilising one, or where a mode on the unit circle is not driven (and none that grows
    is) the limit, whose filter keeps that mode as it is. NaN where there is none.
    """
    least = dare(F, H, Q, R)
    left = F - F @ gain(least, H, R) @ H
    radius = jnp.max(jnp.abs(jnp.linalg.eigvals(lax.stop_gradient(left))))
    # A double root of the Riccati equation is found to the square root of eps only: a mode on the
    # unit circle may come out that far beyond it.
    settled = radius <= 1 + jnp.sqrt(jnp.finfo(F.dtype).eps)

    def follow(_: Array) -> Array:
        return stabilising_dare(F, H, Q, R)

    return lax.cond(settled, lambda P: P, follow, least)


def predicted_dare(F: Array, H: Array, Q: Array, R: Array) -> Array:
    """The solution P (n, n) of `strong_dare`, where R may be singular.

    The estimate after a measurement obeys a Riccati equation too, with the next measurement seen
    from before the motion: z = H F x + (H w + v). Its noise R + H Q H' has an inverse where R has
    none, and what it shares with w is taken out of F and Q.
    """
    taken = jnp.linalg.solve(R + H @ Q @ H.T, H @ Q).T
    kept = jnp.eye(F.shape[0], dtype=F.dtype) - taken @ H
    own = kept @ Q @ kept.T + taken @ R @ taken.T
    after = strong_dare(kept @ F, H @ F, (own + own.T) / 2, R + H @ Q @ H.T)
    before = F @ after @ F.T + Q
    return (before + before.T) / 2


def check_seen_noise(H: Array, Q: Array, R: Array) -> None:
    """Refuses a known R without which nothing keeps the innovations from being exact."""
    given = [checks.concrete_value(x) for x in (H, Q, R)]
    if any(x is None for x in given):
        return
    look, noise, own = (np.asarray(x, float) for x in given)
    total = look @ noise @ look.T + own
    least = np.linalg.eigvalsh(total).min(initial=np.inf)
    enough = least > 8 * len(total) * np.finfo(float).eps * abs(total).max(initial=0.0)
    checks.require(
        enough or np.linalg.eigvalsh(own).min(initial=np.inf) > 0,
        "R",
        "R, or R + H Q H', to be positive definite: what is measured exactly and not driven by "
        "noise is known for good, and has no steady gain (give it a small variance)",
        f"R = {own.tolist()} with smallest eigenvalue {least:.3g} of R + H Q H'",
    )


def stabilising_care(F: Array, H: Array, Q: Array, R: Array) -> Array:
    r"""The solution P (n, n) whose filter is stable; NaN where there is none.

    .. math::
        F P + P F' - P H' R^{-1} H P + Q = 0

    Newton's method (Kleinman 1968) from a solution by Cayley transformation and doubling (Chu, Fan
    & Lin 2005). Derivatives come from the implicit function theorem.
    """
    looking = jnp.linalg.solve(R, H)
    G = H.T @ looking

    def guess(Q: Array) -> Array:
        return dare(*_cayley_transform(F, G, Q))

    def refined(P: Array) -> Array:
        K = P @ looking.T
        return continuous_lyapunov(F - K @ H, K @ R @ K.T + Q)

    def defect(P: Array) -> Array:
        return F @ P + P @ F.T - P @ G @ P + Q

    return _refined_root(defect, guess, refined, Q)


def discrete_lyapunov(A: Array, Q: Array) -> Array:
    """X (n, n) with X = A X A' + Q."""
    return _linear_solution(A, Q, jnp.eye(A.shape[0] ** 2, dtype=A.dtype) - jnp.kron(A, A))


def continuous_lyapunov(A: Array, Q: Array) -> Array:
    """X (n, n) with A X + X A' + Q = 0."""
    eye = jnp.eye(A.shape[0], dtype=A.dtype)
    return _linear_solution(A, Q, -jnp.kron(A, eye) - jnp.kron(eye, A))


def _linear_solution(A: Array, Q: Array, matrix: Array) -> Array:
    X = jnp.linalg.solve(matrix, Q.reshape(-1)).reshape(A.shape)
    return (X + X.T) / 2


def _cayley_transform(F: Array, G: Array, Q: Array) -> tuple[Array, Array, Array, Array]:
    """The discrete problem (F, H, Q, R) with the same stabilising solution."""
    eye = jnp.eye(F.shape[0], dtype=F.dtype)
    # Larger than every eigenvalue of the Hamiltonian matrix, so that none is at the pole of the
    # transformation.
    size = jnp.linalg.norm(F) + jnp.sqrt(jnp.linalg.norm(G) * jnp.linalg.norm(Q))
    shift = 1.1 * size + jnp.finfo(F.dtype).tiny
    inner = jnp.linalg.inv(F.T - shift * eye)
    outer = jnp.linalg.inv((F.T - shift * eye).T + Q @ inner @ G)
    seen = 2 * shift * inner @ G @ outer
    noise = 2 * shift * outer @ Q @ inner
    look = cholesky.factor((seen + seen.T) / 2).lower.T
    return eye + 2 * shift * outer, look, (noise + noise.T) / 2, eye


def _refined_root(
    defect: Callable[[Array], Array],
    guess: Callable[[Array], Array],
    refined: Callable[[Array], Array],
    Q: Array,
) -> Array:
    """The zero of `defect` that `refined` converges to from `guess` of a larger Q."""
    tolerance = 8 * Q.shape[0] * float(jnp.finfo(Q.dtype).eps)

    def going(carry: tuple[Array, Array, Array]) -> Array:
        count, change, P = carry
        return (count < NEWTON_STEPS) & (change > tolerance * jnp.max(jnp.abs(P)))

    def once(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        count, _, P = carry
        better = refined(P)
        return count + 1, jnp.max(jnp.abs(better - P)), better

    def solve(_: object, start: Array) -> Array:
        # More noise in every direction drives every growing mode, so the guess is stabilising; from
        # a stabilising guess Newton's method converges and every iterate stays so (Hewer 1971,
        # Kleinman 1968).
        P = guess(start + (1 + jnp.max(jnp.abs(start))) * jnp.eye(Q.shape[0], dtype=Q.dtype))
        first = (jnp.zeros((), jnp.int32), jnp.full((), jnp.inf, Q.dtype), P)
        return lax.while_loop(going, once, first)[2]

    def tangent_solve(linear: Callable[[Array], Array], y: Array) -> Array:
        matrix = jax.jacfwd(linear)(jnp.zeros_like(y)).reshape(y.size, y.size)
        return jnp.linalg.solve(matrix, y.reshape(-1)).reshape(y.shape)

    return lax.custom_root(defect, Q, solve, tangent_solve)  # type: ignore[arg-type]
