"""Real powers of a filter's loop, and until when what it carries is still large."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array, lax

STRIDES = 300_000


@jax.custom_jvp
def real_power(A: Array, steps: Array) -> Array:
    r"""The real part (n, n) of :math:`A^s` for any number s >= 0, on the principal branch.

    Through the eigenvectors; eigenvalues may repeat, also in the derivative (Daletskii & Krein
    1965), and may be zero. Where there are fewer than n of them it is that of a neighbour of A,
    accurate to two thirds of the digits.
    """
    values, vectors, inverse = _eigen_decomposition(A)
    return jnp.real(vectors * _power_of(values, steps)[None] @ inverse)


@real_power.defjvp
def _real_power_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (A, steps), (A_dot, steps_dot) = primals, tangents
    values, vectors, inverse = _eigen_decomposition(A)
    powers = _power_of(values, steps)
    gap = values[:, None] - values[None]
    close = jnp.abs(gap) <= jnp.finfo(A.dtype).eps ** (1 / 3) * jnp.max(jnp.abs(values))
    slope = steps * _power_of((values[:, None] + values[None]) / 2, steps - 1)
    # Daletskii and Krein: in the eigenvectors the derivative of f(A) is the divided difference of f
    # at each pair of eigenvalues, which for close ones is f' between them.
    rise = jnp.where(close, slope, (powers[:, None] - powers[None]) / jnp.where(close, 1, gap))
    logs = jnp.log(jnp.where(values == 0, 1, values))
    turned = rise * (inverse @ A_dot.astype(values.dtype) @ vectors)
    turned = turned + jnp.diag(powers * logs) * steps_dot
    return real_power(A, steps), jnp.real(vectors @ turned @ inverse)


def last_time_above(A: Array, K: Array, ratio: Array) -> Array:
    r"""The last s () >= 0, in steps, with :math:`\|A^s K\| \ge ratio \|K\|` (Frobenius norms).

    Found from the far end: no stride back is longer than the time in which the norm could make up
    what is missing, so no crossing is jumped over. Derivatives by the implicit function theorem.

    Returns:
        inf where A does not decay, NaN where K = 0 or is NaN.
    """
    K = K / jnp.linalg.norm(K)
    n, eps = A.shape[0], float(jnp.finfo(A.dtype).eps)

    def excess(steps: Array) -> Array:
        return jnp.linalg.norm(real_power(A, steps) @ K) - ratio

    def search(_: object, start: Array) -> Array:
        values, vectors, inverse = _eigen_decomposition(A)
        modes = inverse @ K.astype(values.dtype)
        logs = jnp.log(jnp.where(values == 0, 1, values))
        rates = (vectors * logs[None]) @ inverse
        decay = jnp.where(values == 0, 1, -jnp.real(logs))
        fades = jnp.min(decay) > 4 * n * eps

        def missing(steps: Array) -> tuple[Array, Array]:
            """How far the square of the norm is below that of `ratio`, and a safe stride back."""
            kept = vectors * _power_of(values, steps)[None] @ modes
            gap = ratio**2 - jnp.sum(jnp.square(jnp.real(kept)))
            return gap, _safe_stride(gap, kept, rates)

        def going(carry: tuple[Array, ...]) -> Array:
            count, steps, gap, _ = carry
            return (count < STRIDES) & (steps > 0) & (gap > 32 * eps)

        def slope_back(carry: tuple[Array, ...]) -> tuple[Array, ...]:
            count, steps, _, stride = carry
            steps = jnp.maximum(steps - stride, 0)
            return count + 1, steps, *missing(steps)

        # The norm at s is at most the sum over modes of parts exp(-decay s): beyond `far` each of
        # the n is below ratio / n, so no crossing lies further out.
        parts = jnp.linalg.norm(vectors, axis=0) * jnp.linalg.norm(modes, axis=1)
        far = jnp.log(jnp.maximum(n * jnp.where(values == 0, 0, parts) / ratio, 1)) / decay
        far = jnp.where(fades, jnp.max(far), start)
        first = (jnp.zeros((), jnp.int32), far, *missing(far))
        count, steps, gap, _ = lax.while_loop(going, slope_back, first)
        found = jnp.where((count < STRIDES) & jnp.isfinite(gap), steps, jnp.nan)
        return jnp.where(fades | jnp.isnan(gap), found, jnp.inf)

    def tangent_solve(linear: Callable[[Array], Array], y: Array) -> Array:
        return y / linear(jnp.ones_like(y))

    root = lax.custom_root(excess, jnp.zeros((), A.dtype), search, tangent_solve)
    return root  # type: ignore[return-value]


def _safe_stride(gap: Array, kept: Array, rates: Array) -> Array:
    r"""A time () in which, going back, the square N of the norm of `kept` grows by less than `gap`.

    With :math:`\dot X = L X` it grows within t by no more than
    :math:`-\dot N t + c (e^{2 l t} - 1 - 2 l t) / (2 l)^2` where :math:`l = \|L\|` and
    :math:`c = 2 (\|L X\|^2 + \|X\| \|L^2 X\|) \ge |\ddot N|`, a convex function, below its chord.
    """
    norm = jnp.linalg.norm
    tiny = jnp.finfo(gap.dtype).tiny
    moved = rates @ kept
    slope = jnp.maximum(-2 * jnp.sum(jnp.real(kept) * jnp.real(moved)), 0)
    bend = 2 * (norm(moved) ** 2 + norm(kept) * norm(rates @ moved))
    speed = 2 * norm(rates)

    def growth(time: Array) -> Array:
        turn = speed * time
        return slope * time + bend * (jnp.expm1(turn) - turn) / speed**2

    gap = jnp.maximum(gap, tiny)
    reach = speed**2 * gap / jnp.maximum(bend, tiny)
    # An estimate of where the convex bound reaches the gap, from both of its ends (t^2 for short
    # times, an exponential for long ones); the last line makes it certainly short enough.
    curved = jnp.minimum(jnp.sqrt(2 * reach), jnp.maximum(jnp.log1p(2 * reach), 1.3)) / speed
    most = jnp.minimum(gap / jnp.maximum(slope, tiny), curved)
    return most * jnp.minimum(gap / growth(most), 1)


def _eigen_decomposition(A: Array) -> tuple[Array, Array, Array]:
    """Eigenvalues, eigenvectors and their inverse. Where A has fewer eigenvectors than n, those of
    a neighbour: its distance balances what it changes with what is rounded."""
    eps, n = float(jnp.finfo(A.dtype).eps), A.shape[0]
    values, vectors, inverse = _solved_eigen(A)
    # A fixed matrix without structure: one along a symmetry of A could leave the eigenvalues equal.
    nudge = jnp.cos(jnp.arange(1, n * n + 1, dtype=A.dtype).reshape(n, n))
    other = _solved_eigen(A + eps ** (2 / 3) * jnp.max(jnp.abs(A)) * nudge)
    # A defective A has almost parallel eigenvectors and an inverse of order eps^(-1/2) or more. The
    # neighbour is eps^(2/3) away, which costs two thirds of the digits instead of all.
    sound = jnp.max(jnp.abs(inverse)) < 10 * eps ** (-1 / 3)
    picked = (
        jnp.where(sound, x, y) for x, y in zip((values, vectors, inverse), other, strict=True)
    )
    return tuple(picked)  # type: ignore[return-value]


def _solved_eigen(A: Array) -> tuple[Array, Array, Array]:
    values, vectors = lax.linalg.eig(A, compute_left_eigenvectors=False)
    inverse = jnp.linalg.solve(vectors, jnp.eye(A.shape[0], dtype=vectors.dtype))
    return values, vectors, inverse


def _power_of(values: Array, steps: Array) -> Array:
    """values^steps with 0^0 = 1 and 0^s = 0."""
    zero = values == 0
    raised = jnp.exp(steps * jnp.log(jnp.where(zero, 1, values)))
    return jnp.where(zero, jnp.where(steps == 0, 1, 0), raised)
