"""Exact use of late measurements at constant cost: what the last ones did is kept and corrected."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.estimator import choose, verdict
from ewif_jax.forms.innovations import Compared, sound
from ewif_jax.kernels import cholesky, gaussian, slots, symmetric
from ewif_jax.kernels.batched import kernel, stage, total
from ewif_jax.kernels.small import matmul, matvec
from ewif_jax.models import Model, flow, sight
from ewif_jax.oosm.history import too_late
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Status


class Kept(NamedTuple):
    """Measurements by time, oldest first, L of them with the prior or what has replaced it.

    time (L,); mean (L, n) and cov (L, packed) given all until then; F (L, n, n) from the one
    before; H (L, m, n) and R (L, m, m); gain K (L, n, m), weight S^-1 (L, m, m) and pull S^-1 nu
    (L, m). An absent component has zero H and K, and variance 1.
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


class WindowState(NamedTuple):
    """time (), mean (n,), cov (packed); F (n, n) from the newest kept measurement to now; kept;
    share (): how much of the next measurement is used, or None where that is all."""

    time: Array
    mean: Array
    cov: Array
    F: Array
    kept: Kept
    share: Array | None = None


def asd(model: Model, lag: int) -> Estimator:
    r"""The filter of the joint density of the states at the last `lag` measurements and now.

    .. math::
        p(x_k, x_{k-1}, \ldots, x_{k-L} \mid Z)

    (Koch & Govaers 2011, the accumulated state density; a fixed-lag augmented state). It is stored
    as the filter leaves it, by time: for every measurement i the estimate until then,
    :math:`F_i, H_i, R_i, K_i, S_i^{-1}` and :math:`S_i^{-1} \nu_i`. A late measurement
    :math:`z = u + v,\; u = H x_d` starts from the estimate until its time. What u has in common
    with the states that follow, :math:`D = \mathrm{cov}(x, u)`, with itself,
    :math:`U = \mathrm{cov}(u)`, and its innovation pass each later measurement,

    .. math::
        D^- = F_i D, \quad g = H_i D^-, \quad G = S_i^{-1} g, \quad D = D^- - K_i g, \quad
        U \mathrel{-}= g' G, \quad \nu \mathrel{-}= g' S_i^{-1} \nu_i

    (D and U in Joseph's form). What is stored of that measurement then becomes what it would be had
    z been there: with :math:`S = U + R`,

    .. math::
        \hat x_i \mathrel{+}= D S^{-1} \nu, \quad P_i \mathrel{-}= D S^{-1} D', \quad
        K_i \mathrel{-}= D S^{-1} G', \quad S_i^{-1} \mathrel{+}= G S^{-1} G', \quad
        S_i^{-1} \nu_i \mathrel{-}= G S^{-1} \nu

    So any number of late measurements in any order is used exactly, at a cost of order L n^2 m that
    does not depend on the delay; nothing is filtered again, and no process noise is inverted. A
    nonlinear model is linearised: motion where the filter was, a late measurement at the estimate
    of its own time given all until then.

    Args:
        model: linear or not; its process noise must compose over parts of an interval. Motion back
            in time is not needed.
        lag: how many measurements are kept, >= 1. One older than the newest that has left, or than
            t0, is `TOO_LATE`.

    Reduces to: `kalman` (or `extended`) in sequence; `replay` of it for a linear model.

    Raises:
        ValueError: lag < 1; `init` with `prior=None`.
    """
    checks.require(isinstance(model, Model), "model", "a Model", type(model).__name__)
    count = checks.whole("lag", lag, 1) + 1

    def init(params: Any, prior: Gaussian | None, t0: Any, key: Any = None) -> WindowState:
        del key
        prior = checks.needs_prior(prior, "asd")
        checks.prior(prior)
        mean = jnp.asarray(prior.mean)
        cov = symmetric.pack(jnp.asarray(prior.cov, mean.dtype))
        time, still = jnp.asarray(t0, mean.dtype), jnp.eye(mean.shape[0], dtype=mean.dtype)
        noise = jax.eval_shape(lambda: jnp.asarray(model.measurement_cov(params, np.int32(0), t0)))
        one = jnp.eye(noise.shape[0], dtype=mean.dtype)
        none = jnp.zeros((noise.shape[0], mean.shape[0]), mean.dtype)
        first = Kept(time, mean, cov, still, none, one, none.T, one, none[:, 0])
        kept = jax.tree.map(lambda leaf: jnp.stack([leaf] * count), first)
        return WindowState(time, mean, cov, still, kept)

    def predict(params: Any, state: WindowState, time: Array) -> WindowState:
        time = jnp.asarray(time, state.time.dtype)
        ahead = jnp.maximum(time, state.time)
        mean, F, Q = flow(model, params, state.mean, state.time, ahead)
        checks.shape("F", F, (state.mean.shape[0],) * 2)
        cov = symmetric.congruence(F, state.cov) + symmetric.pack(Q)
        known = time >= state.time
        mean, cov = jnp.where(known, mean, jnp.nan), jnp.where(known, cov, jnp.nan)
        return state._replace(time=time, mean=mean, cov=cov, F=matmul(F, state.F))

    def update(
        params: Any, state: WindowState, measurement: Measurement
    ) -> tuple[WindowState, Info]:
        late, present = measurement.time < state.time, jnp.any(measurement.mask)
        place = jnp.sum(state.kept.time <= measurement.time)
        known = place > 0
        usable = known & present
        mean, cov, F, split = _split(model, params, state, measurement.time, place, usable)
        later = jnp.arange(count) >= place

        at = mean
        if model.linear is None:
            at = mean + symmetric.times(cov, _force(split.kept, later))
        predicted, H, R = sight(model, params, at, measurement.sensor, measurement.time)
        checks.shape("measurement.value", measurement.value, (H.shape[0],))
        difference = model.residual(measurement.value, predicted, measurement.sensor)
        seen = Compared(difference, H, R, measurement.mask & known)
        (difference, H, R, mask), good = sound(model, cov, seen)
        H, R = jnp.where(mask[:, None], H, 0), gaussian.mask_cov(R, mask)
        difference = jnp.where(mask, difference + matvec(H, at - mean), 0)

        cross = symmetric.rows(H, cov).T
        (D, U, nu), passed = _passed(split.kept, later, cross, matmul(H, cross), difference)
        D = matmul(split.F, D)
        whole = gaussian.innovate(nu, D.T, U + R, mask)
        info = Info(
            whole.value,
            whole.cov,
            gaussian.log_density(whole, mask),
            state.time - measurement.time,
            verdict(late, present, Status.LATE_USED, good),
        )
        if state.share is not None:
            R = R + _excess(state.share) * jnp.where(mask[:, None] & mask, whole.cov, 0)
        now = gaussian.update_from_afar(state.mean, state.cov, nu, D.T, U, R, mask)[:2]
        mean, cov, innovation = gaussian.update(mean, cov, difference, H, R, mask)
        weight, pull, gain = _solved(innovation)
        new = Kept(measurement.time, mean, cov, F, H, R, gain, weight, pull)
        kept = _with(new, split.kept, passed, R, place, usable)
        mean, cov = choose(late, now, (mean, cov))
        updated = split._replace(mean=mean, cov=cov, kept=kept)
        if model.linear is None:
            updated = choose(good, updated, state)
        return updated, too_late(info, ~known)

    def estimate(params: Any, state: WindowState) -> Gaussian:
        del params
        return Gaussian(state.mean, symmetric.unpack(state.cov))

    return Estimator(init, predict, update, estimate)


def _split(
    model: Model, params: Any, state: WindowState, time: Array, place: Array, usable: Array
) -> tuple[Array, Array, Array, WindowState]:
    """The filter's estimate at `time` with what is kept until then (mean, cov) and F (n, n) from
    the newest of that; and the state, the interval around `time` beginning there if `usable`."""
    kept, count = state.kept, state.kept.time.shape[0]
    index = jnp.arange(count)
    before, after = index == jnp.maximum(place - 1, 0), index == place
    start, mean, cov = (slots.picked(x, before) for x in kept[:3])
    end = jnp.where(place < count, slots.picked(kept.time, after), state.time)
    time = jnp.clip(time, start, state.time)
    mean, F, Q = flow(model, params, mean, start, time)
    cov = symmetric.congruence(F, cov) + symmetric.pack(Q)
    there = choose(time < state.time, (mean, cov, F), (state.mean, state.cov, state.F))
    _, onward, _ = flow(model, params, there[0], time, end)
    into = (after & usable)[:, None, None]
    kept = kept._replace(F=jnp.where(into, onward[None], kept.F))
    F_now = jnp.where(usable & (place == count), onward, state.F)
    return *there, state._replace(F=F_now, kept=kept)


def _force(kept: Kept, later: Array) -> Array:
    """The pull (n,) of the `later` (L,) measurements on the state before them: its estimate moves
    by P times this."""
    return _drawn(kept.F, kept.H, kept.gain, kept.pull, later)


@kernel
def _drawn(F: Array, H: Array, gain: Array, pull: Array, later: Array) -> Array:
    batch = jnp.broadcast_shapes(*(x.shape[x.ndim - later.ndim + 1 :] for x in (F, H, gain, pull)))

    def back(force: Array, one: tuple[Array, ...]) -> tuple[Array, None]:
        F, H, gain, pull, later = one
        rest = pull - _product(jnp.swapaxes(gain, 0, 1), force)
        before = _product(jnp.swapaxes(F, 0, 1), force + _product(jnp.swapaxes(H, 0, 1), rest))
        return jnp.where(later[None], before, force), None

    return lax.scan(back, jnp.zeros((F.shape[1], *batch), F.dtype), (F, H, gain, pull, later), reverse=True)[0]


class Passed(NamedTuple):
    """D (L, n, m), U (L, m, m) and nu (L, m) behind each kept measurement, and G (L, m, m); D and G
    are zero for those that are not later."""

    D: Array
    U: Array
    nu: Array
    G: Array


def _passed(kept: Kept, later: Array, D: Array, U: Array, nu: Array) -> tuple[Any, Passed]:
    """D (n, m), U (m, m), nu (m,) of a measurement behind all that are kept, and behind each."""
    *last, D, U, nu, G = _pass(*kept[3:], later, D, U, nu)
    return last, Passed(D, U, nu, G)


@kernel
def _pass(
    F: Array, H: Array, R: Array, gain: Array, weight: Array, pull: Array, later: Array,
    D: Array, U: Array, nu: Array,
) -> tuple[Array, ...]:
    batch = nu.ndim - 1

    def behind(carry, one):
        D, U, nu = carry
        F, H, R, gain, weight, pull, later = one
        moved = stage(_product, F, D, batch=batch)
        g = stage(_product, H, moved, batch=batch)
        G = stage(_product, weight, g, batch=batch)
        half = stage(_less, moved, gain, g, batch=batch)
        rounded = stage(_rest, R, G, H, half, batch=batch)
        new = stage(_joseph, half, gain, U, nu, g, G, rounded, pull, batch=batch)
        carry = tuple(jnp.where(later, a, b) for a, b in zip(new, carry, strict=True))
        D, U, nu = carry
        return carry, (jnp.where(later, D, 0), U, nu, jnp.where(later, G, 0))

    everything = (F, H, R, gain, weight, pull, later)
    runs = jnp.broadcast_shapes(*(x.shape[x.ndim - batch:] for x in (*everything, D, U, nu)))
    start = tuple(jnp.broadcast_to(x, x.shape[: x.ndim - batch] + runs) for x in (D, U, nu))
    last, each = lax.scan(behind, start, everything)
    return *last, *each


def _product(a: Array, b: Array) -> Array:
    """a b for a matrix a and a vector or matrix b."""
    if a.ndim > b.ndim:
        return total(a[:, k] * b[None, k] for k in range(b.shape[0]))
    return total(a[:, k, None] * b[None, k] for k in range(b.shape[0]))


def _less(a: Array, b: Array, c: Array) -> Array:
    return a - _product(b, c)


def _rest(R: Array, G: Array, H: Array, half: Array) -> Array:
    """R G - H half: zero but for what `half` was rounded by."""
    return _product(R, G) - _product(H, half)


def _joseph(half, gain, U, nu, g, G, rounded, pull) -> tuple[Array, Array, Array]:
    D = half + _product(gain, rounded)
    back = jnp.swapaxes(G, 0, 1)
    U = U - _product(back, g - rounded)
    nu = nu - _product(jnp.swapaxes(g, 0, 1), pull)
    return D, (U + jnp.swapaxes(U, 0, 1)) / 2, nu


def _with(new: Kept, kept: Kept, passed: Passed, R: Array, place: Array, usable: Array) -> Kept:
    """The kept measurements, those after `place` corrected for `new`, which is inserted before
    them if `usable`; the oldest leaves."""
    D, U, nu, G = passed
    right = jnp.concatenate([jnp.swapaxes(D, 1, 2), jnp.swapaxes(G, 1, 2), nu[:, :, None]], 2)
    ratio = jax.vmap(cholesky.solved)(U + R[None], right)
    index = jnp.arange(U.shape[0]) + 1
    return Kept(*_changed(index < jnp.where(usable, place, 0), (index == place) & usable, D, G, ratio, *kept, *new))


@kernel
def _changed(older: Array, here: Array, D: Array, G: Array, ratio: Array, *tables: Array) -> tuple[Array, ...]:
    kept, new = Kept(*tables[:9]), Kept(*tables[9:])
    n, m = D.shape[1:3]
    gain, innovations, nu = ratio[:, :, :n], ratio[:, :, n : n + m], ratio[:, :, n + m]
    rows, cols = np.triu_indices(n)
    corrected = kept._replace(
        mean=kept.mean + total(D[:, :, j] * nu[:, j, None] for j in range(m)),
        cov=kept.cov - total(D[:, rows, j] * gain[:, j, cols] for j in range(m)),
        gain=kept.gain - total(gain[:, j, :, None] * G[:, None, :, j] for j in range(m)),
        weight=kept.weight + total(G[:, :, None, j] * innovations[:, j, None] for j in range(m)),
        pull=kept.pull - total(G[:, :, j] * nu[:, j, None] for j in range(m)),
    )

    def moved(table: Array, corrected: Array, new: Array) -> Array:
        shape = (here.shape[0], *(1,) * (table.ndim - here.ndim), *here.shape[1:])
        shifted = jnp.concatenate([table[1:], table[-1:]])
        kept = jnp.where(here.reshape(shape), new[None], corrected)
        return jnp.where(older.reshape(shape), shifted, kept)

    return tuple(map(moved, kept, corrected, new))


def _solved(innovation: gaussian.Innovation) -> tuple[Array, Array, Array]:
    """S^-1 (m, m), S^-1 nu (m,) and K (n, m)."""
    m = innovation.value.shape[0]
    eye = jnp.eye(m, dtype=innovation.value.dtype)
    right = jnp.concatenate([eye, innovation.value[:, None], innovation.cross], 1)
    ratio = cholesky.solved(innovation.cov, right)
    return ratio[:, :m], ratio[:, m], ratio[:, m + 1 :].T


def _excess(share: Array) -> Array:
    """1 / g - 1, finite for g = 0."""
    return 1 / jnp.maximum(share, jnp.sqrt(jnp.finfo(share.dtype).tiny)) - 1
