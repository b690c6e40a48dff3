"""The exponentially weighted estimate that looks both ways in time."""

from functools import partial, reduce

import jax
import jax.numpy as jnp
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.kernels.growth import decayed, exponential
from ewif_jax.kernels.trees import choose
from ewif_jax.latency import on_time
from ewif_jax.models.components import existing
from ewif_jax.models.entry import (
    check_covariances_of,
    check_span,
    check_times,
    without_process_noise,
)
from ewif_jax.models.linearise import need_known_noise, need_linear, need_reversible
from ewif_jax.models.model import Model, resolve
from ewif_jax.models.sensor_range import check_sensors
from ewif_jax.models.steps import whole_steps
from ewif_jax.recursions import information as form
from ewif_jax.recursions.information import InformationState
from ewif_jax.recursions.invertible import refuse_exact, refuse_one_way
from ewif_jax.streams import cast, float_dtype, given
from ewif_jax.types import Gaussian, Measurement, Numbers, Parameter, Params, Status


def two_sided_ewif(
    model: Model,
    params: Params,
    measurements: Measurement,
    *,
    tau: Parameter,
    prior: Gaussian | None = None,
    t0: Numbers = None,
    times: Numbers = None,
) -> Gaussian:
    r"""The least-squares estimate in which a measurement s seconds away counts exp(-|s| / tau).

    .. math::
        P_k^{-1} = \sum_l e^{-|t_k - t_l| / \tau} A_{l,k}' H_l' R_l^{-1} H_l A_{l,k}

    and likewise for the vector: eqs. (8)-(9) of Shulami & Sigalov with the symmetric
    :math:`W_{l,k} = e^{-|t_k - t_l| / 2\tau}`. That weight breaks (11c), so no single recursion
    gives it; on each side of t_k it is a semigroup, so one pass forward and one backward do.

    Args:
        model: a linear `Model` that can be moved both ways; its process noise is ignored.
        params: what its parameters are read from; differentiable.
        measurements: T measurements in any order.
        tau: decay time in seconds, > 0, a number or a function of `params`.
        prior: a measurement of the whole state at t0, weighted like the others; or None.
        t0: its time in seconds (any), needed with a prior.
        times: (K,) seconds, when to estimate; default the measurement times.

    Returns:
        `Gaussian`: mean (K, n) and cov (K, n, n); NaN where the weighted measurements do not
        determine the state, or where one that counts cannot be used (an R that turns out singular
        inside a trace, motion without a way back). cov is (9), not the covariance of the error
        under model (3).

    Raises:
        ValueError: a tau that is not one number > 0, an unusable stream or prior, a prior without
            t0, a model that is not linear.

    Reduces to: `batch_wls` with that weight; `ewif` at the newest time.

    Deviations: beyond the paper, whose smoothing (section VI-A) weights newer data above 1.
    """
    need_linear(model, "two_sided_ewif")
    need_reversible(model, "two_sided_ewif")
    need_known_noise(model, "two_sided_ewif")
    params, measurements, prior, t0, times = given(params, measurements, prior, t0, times)
    measurements = on_time(model, None, params, measurements)
    check_sensors(model, params, None, measurements)
    decay = checks.positive_number("tau", resolve(tau, params))
    refuse_exact(model, params, checks.with_dtype(measurements.time).min(), "two_sided_ewif")
    refuse_one_way(model, params, "two_sided_ewif")
    dtype = float_dtype(measurements.value)
    check_times(model, measurements, t0, dtype, times, in_order=False)
    stamps = measurements.time
    check_span(model, (t0,), stamps if times is None else times)
    seen_by = without_process_noise(model)
    check_covariances_of(seen_by, params, stamps, stamps, measurements.sensor)
    if times is not None:
        times = jnp.asarray(times, dtype)
    if prior is not None:
        checks.prior(prior)
        checks.psd("prior.cov", prior.cov, definite=True)
        checks.require(t0 is not None, "t0", "the time of the prior", None)
        t0 = jnp.asarray(t0, dtype)
        prior = Gaussian(jnp.asarray(prior.mean, dtype), jnp.asarray(prior.cov, dtype))
    decay = jnp.asarray(decay, dtype).reshape(())
    seen = cast(existing(model, measurements), dtype)
    return _two_sided(model, params, seen, decay, prior, t0, times)


@partial(jax.jit, static_argnames="model")
def _two_sided(
    model: Model,
    params: Params,
    measurements: Measurement,
    tau: Array,
    prior: Gaussian | None,
    t0: Numbers,
    times: Array | None,
) -> Gaussian:
    times = measurements.time if times is None else times
    order = jnp.argsort(measurements.time)
    in_time = jax.tree.map(lambda x: x[order], measurements)
    if model.steps is not None:
        first = in_time.time[0]
        whole = whole_steps(model.steps._replace(max_steps=2**30), first, in_time.time)
        in_time = in_time._replace(
            time=lax.cummax(jnp.where(whole, in_time.time, first)),
            mask=in_time.mask & whole[:, None],
        )

    def moved(state: InformationState, time: Array) -> InformationState:
        age = jnp.abs(time - state.time)
        return form.transport(model, params, state, time, lambda v: decayed(v, age, tau))

    def gathered(reverse: bool) -> tuple[InformationState, Array]:
        """What the first (reversed: the last) 0, 1, ..., T measurements say, T + 1 states, and
        which were not taken (T,)."""
        nothing = form.start(model, params, None, in_time.time[-1 if reverse else 0])

        def body(state: InformationState, measurement: Measurement):
            here = moved(state, measurement.time)
            state, info = form.absorb(model, params, here, measurement, 1.0)
            return state, (state, info.status == Status.REJECTED)

        _, (states, rejected) = lax.scan(body, nothing, in_time, reverse=reverse)
        one = jax.tree.map(lambda x: x[None], nothing)
        ends = (states, one) if reverse else (one, states)
        return jax.tree.map(lambda *x: jnp.concatenate(x), *ends), rejected

    # `past` k holds the first k measurements and `future` k the others: no measurement is in both,
    # so their information adds up.
    (past, rejected), (future, _) = gathered(reverse=False), gathered(reverse=True)
    count = jnp.searchsorted(in_time.time, times, side="right")
    # An estimate that lacks one of its measurements would be a wrong number without a status. Of
    # those that could not be used the nearest on each side weighs most.
    rejected &= jnp.any(in_time.mask, 1)
    before = lax.cummax(jnp.where(rejected, in_time.time, -jnp.inf))
    after = lax.cummin(jnp.where(rejected, in_time.time, jnp.inf), reverse=True)
    before = jnp.concatenate([jnp.full(1, -jnp.inf, before.dtype), before])
    after = jnp.concatenate([after, jnp.full(1, jnp.inf, after.dtype)])

    def smoothed_at(time: Array, k: Array) -> Gaussian:
        # The prior is a third source: its age counts both ways, as a measurement's at t0 would.
        sources = [jax.tree.map(lambda x: x[k], side) for side in (past, future)]
        if prior is not None:
            sources.append(form.start(model, params, prior, t0))
        moved_here = [moved(source, time) for source in sources]
        found = form.estimate(form.recentred(reduce(form.joined, moved_here)))
        nearest = jnp.minimum(time - before[k], after[k] - time)
        lacking = jnp.isfinite(exponential(nearest, lax.stop_gradient(tau)))
        return choose(lacking, jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), found), found)

    return jax.vmap(smoothed_at)(times, count)
