"""Exact use of late measurements at constant cost: what the last ones did is kept and corrected."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ewif_jax import checks
from ewif_jax.fast import slots
from ewif_jax.fast.small import matmul, matvec
from ewif_jax.fast.sparse import dense
from ewif_jax.kernels import cholesky, gaussian, symmetric, window
from ewif_jax.kernels.trees import choose, copies
from ewif_jax.models import Model, predict_state
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.innovations import compared, info_of, sound
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Params, RandomKey


class WindowState(NamedTuple):
    """time (), mean (n,), cov (packed); F (n, n) from the newest kept measurement to now; kept;
    share (): how much of the next measurement is used, or None where that is all."""

    time: Array
    mean: Array
    cov: Array
    F: Array
    kept: window.Kept
    share: Array | None = None


@from_recipe
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

    (D in Joseph's form). What is stored of that measurement then becomes what it would be had
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

    U is a difference: where the kept measurements leave less of it than the rounding of what it was
    (in float32 less than about 1e-6: a vague prior, precise sensors, and a measurement older than
    the first), use `replay` or float64.

    Reduces to: `kalman` (or `extended`) in sequence; `replay` of it for a linear model.

    Raises:
        ValueError: lag < 1; `init` with `prior=None`.
    """
    checks.require(isinstance(model, Model), "model", "a Model", type(model).__name__)
    count = checks.whole("lag", lag, 1) + 1

    def start(params: Params, prior: Gaussian, t0: Array, key: RandomKey) -> WindowState:
        del key
        mean, cov = prior.mean, symmetric.pack(prior.cov)
        still = jnp.eye(mean.shape[0], dtype=mean.dtype)
        noise = jax.eval_shape(lambda: jnp.asarray(model.measurement_cov(params, np.int32(0), t0)))
        # Empty slots hold a measurement with H = 0 and unit noise at t0: it passes D, U and nu
        # unchanged, so no slot has to be asked whether it is filled.
        one = jnp.eye(noise.shape[0], dtype=mean.dtype)
        none = jnp.zeros((noise.shape[0], mean.shape[0]), mean.dtype)
        first = window.Kept(t0, mean, cov, still, none, one, none.T, one, none[:, 0])
        return WindowState(t0, mean, cov, still, copies(first, count))

    def move(params: Params, state: WindowState, time: Array) -> WindowState:
        mean, F, Q = predict_state(model, params, state.mean, state.time, time)
        cov = symmetric.congruence(F, state.cov) + symmetric.pack(Q)
        return state._replace(time=time, mean=mean, cov=cov, F=matmul(F, state.F))

    def is_after_oldest(params: Params, state: WindowState, time: Array) -> Array:
        del params
        return time >= state.kept.time[0]

    def measure(
        params: Params, state: WindowState, measurement: Measurement
    ) -> tuple[WindowState, Info]:
        place = jnp.sum(state.kept.time <= measurement.time)
        mean, cov, before, after = _split_at(model, params, state, measurement.time, place)
        first = jnp.arange(count) == place

        # A nonlinear sensor is linearised at the smoothed mean: what the kept measurements after it
        # pull on a state before them moves the estimate there by P times that force.
        linearised_at = mean
        if model.linear is None:
            linearised_at = mean + symmetric.times(cov, window.force(state.kept, first, after))
        seen = compared(model, params, linearised_at, measurement)
        (difference, H, R, mask), accepted = sound(model, cov, seen)
        H, R = jnp.where(mask[:, None], dense(H), 0), gaussian.mask_cov(R, mask)
        # The line through h at the smoothed mean, seen from the filter's own mean of that time:
        # what passes the later measurements below is relative to the latter.
        difference = jnp.where(mask, difference + matvec(H, linearised_at - mean), 0)

        cross = symmetric.rows(H, cov).T
        entry = matmul(after, cross)
        passed = window.passed(state.kept, first, entry, matmul(H, cross), difference)
        D = matmul(state.F, passed.D[-1]) + jnp.where(place == count, entry, 0)
        U, nu = passed.U[-1], passed.nu[-1]
        size = gaussian.sizes(cov, H, R)
        whole = gaussian.innovate(nu, D.T, U + R, mask, size)
        if state.share is not None:
            # A share g of an update is the update with S / g in place of S = U + R: so R grows by S
            # (1/g - 1) (`recursions/partial_use.py`).
            R = R + _excess_noise(state.share) * jnp.where(
                mask[:, None] & mask[None, :], whole.cov, 0
            )
        now = gaussian.update_from_afar(state.mean, state.cov, nu, D.T, U, R, mask, size)[:2]
        mean, cov, innovation = gaussian.update(mean, cov, difference, H, R, mask)
        weight, pull, gain = _solved_innovation(innovation)
        new = window.Kept(measurement.time, mean, cov, after, H, R, gain, weight, pull)
        mean, cov = choose(measurement.time < state.time, now, (mean, cov))
        used = jnp.any(mask)
        updated = state._replace(
            mean=mean,
            cov=cov,
            F=jnp.where(used & (place == count), after, state.F),
            kept=window.inserted(new, before, state.kept, passed, R, jnp.where(used, place, 0)),
        )
        return updated, info_of(whole, mask, accepted)

    def estimate(params: Params, state: WindowState) -> Gaussian:
        del params
        return Gaussian(state.mean, symmetric.unpack(symmetric.no_negative(state.cov)))

    # What is masked has H = 0 and corrects nothing: every number of the state stays.
    return estimator_from(
        Recursion("asd", start, move, measure, estimate, is_after_oldest, keeps=True, model=model)
    )


def _split_at(
    model: Model, params: Params, state: WindowState, time: Array, place: Array
) -> tuple[Array, Array, Array, Array]:
    """The filter's estimate at `time` with what is kept until then, mean (n,) and cov (packed), F
    (n, n) to there from the newest of that, and from there to what comes next."""
    kept, count = state.kept, state.kept.time.shape[0]
    index = jnp.arange(count)
    here = index == jnp.maximum(place - 1, 0)
    start, mean, cov = (slots.picked(x, here) for x in kept[:3])
    end = jnp.where(place < count, slots.picked(kept.time, index == place), state.time)
    # A time out of reach is masked later; clipped, it asks the model for no interval that it may
    # not have.
    time = jnp.clip(time, start, state.time)
    mean, F, Q = predict_state(model, params, mean, start, time)
    cov = symmetric.congruence(F, cov) + symmetric.pack(Q)
    mean, cov, F = choose(
        time < state.time, (mean, cov, dense(F)), (state.mean, state.cov, state.F)
    )  # in sequence exactly what the filter has
    return mean, cov, F, dense(predict_state(model, params, mean, time, end)[1])


def _solved_innovation(innovation: gaussian.Innovation) -> tuple[Array, Array, Array]:
    """S^-1 (m, m), S^-1 nu (m,) and K (n, m)."""
    m = innovation.value.shape[0]
    eye = jnp.eye(m, dtype=innovation.value.dtype)
    # One solve for all three: the factor is walked through once.
    right = jnp.concatenate([eye, innovation.value[:, None], innovation.cross], 1)
    ratio = cholesky.solve(innovation.factor, right)
    return ratio[:, :m], ratio[:, m], ratio[:, m + 1 :].T


def _excess_noise(share: Array) -> Array:
    """1 / g - 1, finite for g = 0."""
    return 1 / jnp.maximum(share, jnp.sqrt(jnp.finfo(share.dtype).tiny)) - 1
