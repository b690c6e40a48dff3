"""The limited-memory filter: least squares over a sliding window."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.models.entry import without_process_noise
from ewif_jax.models.linearise import need_known_noise, need_linear, need_reversible
from ewif_jax.models.model import Model, resolve
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions import information as form
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.information import InformationState
from ewif_jax.recursions.invertible import refuse_exact
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Parameter, Params, RandomKey


class MemoryState(NamedTuple):
    """time (), start: what the prior says, buffer: the newest `capacity` measurements."""

    time: Array
    start: InformationState
    buffer: Measurement


@from_recipe
def limited_memory(model: Model, window: Parameter, capacity: int) -> Estimator:
    r"""The least-squares estimate from the measurements of the last `window` seconds.

    .. math::
        \hat x_k = \Big( \sum_{|t_k - t_l| \le w} A_{l,k}' H_l' R_l^{-1} H_l A_{l,k} \Big)^{-1}
            \sum_{|t_k - t_l| \le w} A_{l,k}' H_l' R_l^{-1} (y_l - H_l c_{l,k})

    Shulami & Sigalov (8)-(9) with the kernel (5); the remedy for divergence that Anderson (1973),
    section 4, compares with. The kernel is not a semigroup, so the measurements themselves are
    kept: `capacity` of them, dropping the oldest in validity time. A late measurement inside the
    window counts like any other. A prior counts as a measurement of the state at t0.

    Args:
        model: a linear `Model`; its process noise is ignored.
        window: w in seconds, > 0, a number or a function of `params`.
        capacity: how many measurements are kept; choose it to hold a full window.

    `prior=None` is accepted: NaN until the window determines the state, and again after a gap. A
    measurement older than the window or than a full buffer is `TOO_LATE`.

    Reduces to: Savitzky-Golay for polynomial models and equal noise (report at the window's
        middle for the symmetric one).

    Raises:
        ValueError: window <= 0; capacity < 1; a model that is not linear.
    """
    linear = need_linear(model, "limited_memory")
    need_reversible(model, "limited_memory")
    need_known_noise(model, "limited_memory")
    checks.whole("capacity", capacity, 1)
    if not callable(window):
        checks.positive_number("window", window)

    def first_state(
        params: Params, prior: Gaussian | None, t0: Array, key: RandomKey
    ) -> MemoryState:
        del key
        checks.positive_number("window", resolve(window, params))
        refuse_exact(model, params, t0, "limited_memory")
        start = form.start(model, params, prior, t0)
        # As an argument: a table of NumPy cannot be indexed while tracing.
        m = jax.eval_shape(
            lambda own: jnp.asarray(linear.H(own, jnp.zeros((), jnp.int32), start.time)), params
        ).shape[0]
        buffer = Measurement(
            jnp.full(capacity, -jnp.inf, start.time.dtype),
            jnp.zeros((capacity, m), start.time.dtype),
            jnp.zeros(capacity, jnp.int32),
            jnp.zeros((capacity, m), bool),
        )
        return MemoryState(start.time, start, buffer)

    def fit(params: Params, state: MemoryState, time: Array) -> InformationState:
        """Everything inside the window, at `time`."""
        half = resolve(window, params)
        inside = jnp.abs(time - state.start.time) <= half
        counted = jnp.where(inside, state.start.variances, jnp.inf)
        base = state.start._replace(variances=counted)
        base = form.transport(model, params, base, jnp.where(inside, time, base.time))
        base = base._replace(time=time)
        stamps = state.buffer.time
        near = jnp.abs(time - stamps) <= half
        # What is outside of the window is masked and moved to the present: motion over the interval
        # of an empty slot (from -inf) would be NaN, and its slope too.
        safe = state.buffer._replace(
            time=jnp.where(near, stamps, time), mask=state.buffer.mask & near[:, None]
        )
        told, targets, noise, sizes = jax.vmap(partial(form.contribution, model, params, base))(
            safe
        )
        told, sizes = (x.reshape(-1, x.shape[-1]) for x in (told, sizes))
        return form.recentred(form.gathered(base, told, noise.ravel(), targets.ravel(), sizes))

    def move(params: Params, state: MemoryState, time: Array) -> MemoryState:
        del params
        return state._replace(time=time)

    def is_inside(params: Params, state: MemoryState, time: Array) -> Array:
        in_window = state.time - time <= resolve(window, params)
        return in_window & (time >= jnp.min(state.buffer.time))

    def measure(
        params: Params, state: MemoryState, measurement: Measurement
    ) -> tuple[MemoryState, Info]:
        # The oldest in validity time goes, not the first that came: a late measurement must not
        # push out a newer one.
        oldest = jnp.argmin(state.buffer.time)
        buffer = jax.tree.map(lambda kept, new: kept.at[oldest].set(new), state.buffer, measurement)
        before = fit(params, state, state.time)
        _, info = form.absorb(model, params, before, measurement, 1.0)
        return state._replace(buffer=buffer), info

    def estimate(params: Params, state: MemoryState) -> Gaussian:
        return form.estimate(fit(params, state, state.time))

    recursion = Recursion("limited_memory", first_state, move, measure, estimate, is_inside)
    recursion = recursion._replace(moves_back=True, starts_from_nothing=True, inverts_prior=True)
    return estimator_from(recursion._replace(model=without_process_noise(model)))
