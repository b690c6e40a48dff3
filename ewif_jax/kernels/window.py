"""The last measurements of a filter, and what a late one among them does to the rest."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax.fast.batched import kernel, stage, total
from ewif_jax.fast.small import matvec
from ewif_jax.kernels import cholesky


class Kept(NamedTuple):
    """Measurements by time, oldest first, L of them with the prior or what has replaced it.

    time (L,); mean (L, n) and cov (L, packed) given all until then; F (L, n, n) to the next (the
    last one unused); H (L, m, n) and R (L, m, m); gain K (L, n, m), weight S^-1 (L, m, m) and pull
    S^-1 nu (L, m). An absent component has zero H and K, and variance 1.
    """

    time: Array
    mean: Array
    cov: Array
    F: Array
    H: Array
    R: Array
    gain: Array
    weight: Array
    pull: Array


def force(kept: Kept, first: Array, F: Array) -> Array:
    """The pull (n,) of the measurements from `first` (L,) on, F after it, on a state before them,
    whose estimate moves by P times this."""
    return matvec(F.T, _pulled_kernel(first, kept.H, kept.gain, kept.pull, kept.F))


@kernel
def _pulled_kernel(first: Array, *kept: Array) -> Array:
    batch = first.ndim - 1
    runs = jnp.broadcast_shapes(*(x.shape[x.ndim - batch :] for x in (first, *kept)))
    later = jnp.cumsum(first, 0) > 0

    def pulled_back(pull_on: Array, one: tuple[Array, ...]) -> tuple[Array, None]:
        later, H, gain, pull, F = one
        # The adjoint of a filter step: on a state before measurement k act F' times the pull on the
        # state behind it, through (I - K H)', and H' S^-1 nu of the measurement itself: H'(pull -
        # K' f) + f (de Jong 1989, Bryson and Frazier 1963).
        force_then = _product_of(_turned_matrix(F), pull_on)
        rest = pull - _product_of(_turned_matrix(gain), force_then)
        return jnp.where(
            later[None], force_then + _product_of(_turned_matrix(H), rest), pull_on
        ), None

    start = jnp.zeros((kept[0].shape[2], *runs), kept[0].dtype)
    return lax.scan(pulled_back, start, (later, *kept), reverse=True)[0]


class Passed(NamedTuple):
    """Of a late measurement behind each kept one: D (L, n, m), U (L, m, m), nu (L, m) and
    G (L, m, m); D and G are zero for those that are earlier."""

    D: Array
    U: Array
    nu: Array
    G: Array


def passed(kept: Kept, first: Array, D: Array, U: Array, nu: Array) -> Passed:
    """Passes D (n, m), U (m, m), nu (m,) along the kept ones, beginning with the `first` (L,)."""
    return Passed(*_pass_kernel(first, *kept[3:], D, U, nu))


@kernel
def _pass_kernel(first: Array, *arrays: Array) -> tuple[Array, ...]:
    (F, H, R, gain, weight, pull), (entry, U, nu) = arrays[:6], arrays[6:]
    batch = nu.ndim - 1
    runs = jnp.broadcast_shapes(*(x.shape[x.ndim - batch :] for x in (first, *arrays)))
    entry = jnp.broadcast_to(entry, entry.shape[:2] + runs)

    def behind(D: Array, one: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        first, F, H, gain, share = one
        g = stage(_seen_entry, H, first, entry, D, batch=batch)
        half = stage(_gain_less, first, entry, D, gain, g, batch=batch)
        # Joseph's form in two steps, as in `gaussian.update`: D - K H D, then K times R S^-1 g - H
        # half. The last is zero in exact numbers and takes out what rounding the gain left.
        rounded = stage(_rounding_left, share, g, H, half, batch=batch)
        D = stage(_gain_more, half, gain, rounded, batch=batch)
        return stage(_product_of, F, D, batch=batch), (D, g, rounded)

    share = _products_of(R, weight)
    # Only D needs the order of time. What is accumulated of U and nu are sums over the
    # measurements, taken at once after the loop: fewer operations in the scan, which a batch pays
    # for at every place.
    D, g, rounded = lax.scan(behind, jnp.zeros_like(entry), (first, F, H, gain, share))[1]
    G = _products_of(weight, g)
    taken = _products_of(jnp.swapaxes(G, 1, 2), g - rounded)
    told = total(g[:, k] * pull[:, k, None] for k in range(g.shape[1]))
    return D, U[None] - jnp.cumsum(taken, 0), nu[None] - jnp.cumsum(told, 0), G


def _product_of(a: Array, b: Array) -> Array:
    """a b for a matrix a and a vector or matrix b."""
    if a.ndim > b.ndim:
        return total(a[:, k] * b[None, k] for k in range(b.shape[0]))
    return total(a[:, k, None] * b[None, k] for k in range(b.shape[0]))


def _products_of(a: Array, b: Array) -> Array:
    """a b for matrices (L, ., .)."""
    return total(a[:, :, k, None] * b[:, None, k] for k in range(b.shape[1]))


def _turned_matrix(a: Array) -> Array:
    return jnp.swapaxes(a, 0, 1)


def _seen_entry(H: Array, first: Array, entry: Array, D: Array) -> Array:
    return _product_of(H, jnp.where(first[None, None], entry, D))


def _gain_less(first: Array, entry: Array, D: Array, gain: Array, g: Array) -> Array:
    return jnp.where(first[None, None], entry, D) - _product_of(gain, g)


def _rounding_left(share: Array, g: Array, H: Array, half: Array) -> Array:
    """R S^-1 g - H half: zero but for what `half` was rounded by."""
    return _product_of(share, g) - _product_of(H, half)


def _gain_more(half: Array, gain: Array, rounded: Array) -> Array:
    return half + _product_of(gain, rounded)


def inserted(new: Kept, before: Array, kept: Kept, behind: Passed, R: Array, place: Array) -> Kept:
    """The kept measurements: `new`, to which F is `before`, in its place (0: left out), those after
    it corrected, the oldest gone."""
    D, U, nu, G = behind
    eye = jnp.broadcast_to(jnp.eye(R.shape[0], dtype=R.dtype), U.shape)
    # For every place at once, though one is used: which one is a traced number, and a batch would
    # have to gather.
    weight = jax.vmap(cholesky.solved)(U + R[None], eye)
    index = jnp.arange(U.shape[0]) + 1
    flags = index < place, index == place, index + 1 == place
    return Kept(*_changed_kernel(*flags, before, D, G, nu, weight, *kept, *new))


@kernel
def _changed_kernel(
    older: Array,
    here: Array,
    last: Array,
    before: Array,
    D: Array,
    G: Array,
    nu: Array,
    weight: Array,
    *tables: Array,
) -> tuple[Array, ...]:
    kept, new = Kept(*tables[:9]), Kept(*tables[9:])
    batch, m = nu.ndim - 2, nu.shape[1]
    gain = stage(_products_of, D, weight, batch=batch)
    share = stage(_products_of, G, weight, batch=batch)
    rows, cols = np.triu_indices(D.shape[1])
    # Each later estimate takes the new measurement as one update with the covariance D and
    # innovation covariance U + R that hold behind it. Gain and weight follow from the inverse of a
    # block matrix: the earlier measurement's innovation is no longer independent of the new one.
    corrected = kept._replace(
        mean=kept.mean + total(gain[:, :, j] * nu[:, None, j] for j in range(m)),
        cov=kept.cov - total(D[:, rows, j] * gain[:, cols, j] for j in range(m)),
        gain=kept.gain - _products_of(gain, jnp.swapaxes(G, 1, 2)),
        weight=kept.weight + _products_of(share, jnp.swapaxes(G, 1, 2)),
        pull=kept.pull - total(share[:, :, j] * nu[:, None, j] for j in range(m)),
    )

    def wide(flags: Array, like: Array) -> Array:
        return flags.reshape(flags.shape[0], *(1,) * (like.ndim - flags.ndim), *flags.shape[1:])

    def moved(table: Array, corrected: Array, new: Array) -> Array:
        later = jnp.where(wide(here, table), new[None], corrected)
        return jnp.where(wide(older, table), jnp.concatenate([table[1:], table[-1:]]), later)

    result = Kept(*map(moved, kept, corrected, new))
    return tuple(result._replace(F=jnp.where(wide(last, kept.F), before[None], result.F)))
