"""The Rauch-Tung-Striebel smoother: every state given all the measurements."""

from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.fast.small import matmul, matvec
from ewif_jax.kernels import cholesky, symmetric
from ewif_jax.latency import on_time
from ewif_jax.models.angles import state_difference
from ewif_jax.models.components import existing
from ewif_jax.models.entry import check_covariances_of, check_times
from ewif_jax.models.linearise import need_model
from ewif_jax.models.model import Model
from ewif_jax.models.sensor_range import check_sensors
from ewif_jax.models.steps import whole_steps
from ewif_jax.recursions.sigma_points import SigmaPoints, flow_around, measure_around, transform
from ewif_jax.streams import cast, float_dtype, given
from ewif_jax.types import Gaussian, Measurement, Numbers, Parameter, Params

FORMS = ("extended", "unscented")


class Moved(NamedTuple):
    """One step of the forward pass: where it left from (mean, packed cov), F, packed Q, and where
    it was predicted to arrive (mean)."""

    left: Array
    left_cov: Array
    F: Array
    Q: Array
    predicted: Array


def rts(
    model: Model,
    params: Params,
    measurements: Measurement,
    *,
    prior: Gaussian,
    t0: Numbers,
    form: Literal["extended", "unscented"] = "extended",
    ut_alpha: Parameter = 1.0,
    ut_beta: Parameter = 0.0,
    ut_kappa: Parameter = 0.0,
) -> Gaussian:
    r"""The state at the time of each measurement, given all the measurements.

    .. math::
        G_k &= P_{k|k} F_k' P_{k+1|k}^{-1} \\
        x_{k|T} &= x_{k|k} + G_k (x_{k+1|T} - x_{k+1|k}) \\
        P_{k|T} &= (I - G_k F_k) P_{k|k} (I - G_k F_k)' + G_k (P_{k+1|T} + Q_k) G_k'

    Rauch, Tung & Striebel (1965); Pornsarayouth & Yamakita (93)-(94), backward through a forward
    filter. Where the model is not linear, F is its Jacobian at the filtered mean ("extended"), or
    the slope that sigma points of the filtered estimate give it, with what that leaves over in Q
    ("unscented"): then :math:`P_{k|k} F_k'` is the unscented cross-covariance, and this is the
    smoother of Sarkka (2008). The covariance is written as a sum of positive semidefinite terms; it
    equals the usual :math:`P_{k|k} + G_k (P_{k+1|T} - P_{k+1|k}) G_k'`. Singular Q and singular P
    are allowed.

    Args:
        model: any `Model` with process noise defined for t1 >= t0.
        params: what its parameters are read from; differentiable.
        measurements: T measurements; they are put in time order here. One with nothing in it is
            just a time to report at: the state is predicted to it and on from it, which for a
            model that is not linear is not quite the one prediction across it that `run` makes.
        prior: Gaussian at t0.
        t0: its time in seconds, not later than any measurement.
        form: "extended" or "unscented".
        ut_alpha, ut_beta, ut_kappa: as in `unscented`, for that form.

    Returns:
        `Gaussian`: mean (T, n) and cov (T, n, n) at the measurement times, in the stream's order;
        NaN if a time inside a trace turns out to be earlier than t0.

    Raises:
        ValueError: an unusable stream or prior, a measurement earlier than t0, an unknown form, or
            settings that `unscented` refuses.

    Reduces to: `kalman` (or `extended`, `unscented`) at the last time; the joint Gaussian posterior
        for linear models.

    Deviations: (94) prints the last factor transposed.
    """
    need_model(model, "rts")
    params, measurements, start, t0, _ = given(params, measurements, prior, t0, None)
    measurements = on_time(model, None, params, measurements)
    prior = checks.needs_prior(start, "rts")
    checks.prior(prior)
    checks.require(t0 is not None, "t0", "the time of the prior in seconds", None)
    check_sensors(model, params, prior.mean, measurements)
    dtype = float_dtype(measurements.value)
    check_times(model, measurements, t0, dtype, in_order=False)
    check_covariances_of(model, params, t0, measurements.time, measurements.sensor)
    measurements = cast(existing(model, measurements), dtype)
    times, begin = checks.concrete_value(measurements.time), checks.concrete_value(t0)
    if times is not None and begin is not None:
        early = float(times.min())
        begin = begin.astype(dtype)
        checks.require(early >= begin, "measurements.time", f"times from t0 = {begin} on", early)
    checks.require(form in FORMS, "form", f"one of {FORMS}", repr(form))
    points = SigmaPoints(ut_alpha, ut_beta, ut_kappa) if form == "unscented" else None
    prior = Gaussian(jnp.asarray(prior.mean, dtype), jnp.asarray(prior.cov, dtype))
    if points is not None:
        transform(points, params, prior.mean.shape[0], dtype)
    return _smoothed_series(model, points, params, measurements, prior, jnp.asarray(t0, dtype))


@partial(jax.jit, static_argnames=("model", "points"))
def _smoothed_series(
    model: Model,
    points: SigmaPoints | None,
    params: Params,
    measurements: Measurement,
    prior: Gaussian,
    t0: Array,
) -> Gaussian:
    order = jnp.argsort(measurements.time)
    in_time = jax.tree.map(lambda x: x[order], measurements)

    def ahead(state: tuple[Array, Array, Array], measurement: Measurement):
        time, left, left_cov = state
        if model.steps is not None:
            whole = whole_steps(model.steps, time, measurement.time)
            measurement = measurement._replace(
                time=jnp.where(whole, measurement.time, time), mask=measurement.mask & whole
            )
        predicted, F, Q = flow_around(model, points, params, left, left_cov, time, measurement.time)
        Q = symmetric.pack(Q)
        cov = symmetric.congruence(F, left_cov) + Q
        mean, cov, _ = measure_around(model, points, params, predicted, cov, measurement)
        mean = jnp.where(measurement.time >= time, mean, jnp.nan)
        return (measurement.time, mean, cov), Moved(left, left_cov, F, Q, predicted)

    def smoothed_back(later: tuple[Array, Array], moved: Moved):
        spread = symmetric.congruence(moved.F, moved.left_cov) + moved.Q
        cross = matmul(moved.F, symmetric.unpack(moved.left_cov))
        G = cholesky.solve(cholesky.factor(symmetric.unpack(spread)), cross).T
        # Sums of squares. P + G (P_T - P^-) G' subtracts two covariances, which in float32 leaves
        # negative variances where the smoother gains much.
        rest = jnp.eye(G.shape[0], dtype=G.dtype) - matmul(G, moved.F)
        mean = moved.left + matvec(G, state_difference(model, later[0], moved.predicted))
        cov = symmetric.congruence(rest, moved.left_cov)
        cov = cov + symmetric.congruence(G, later[1] + moved.Q)
        return (mean, cov), later

    first = (t0, prior.mean, symmetric.pack(prior.cov))
    (_, last, last_cov), steps = lax.scan(ahead, first, in_time)
    _, (mean, cov) = lax.scan(smoothed_back, (last, last_cov), steps, reverse=True)
    place = jnp.argsort(order)
    return Gaussian(mean[place], jax.vmap(symmetric.unpack)(cov)[place])
