"""What no filter can beat: the posterior Cramer-Rao bound, with and without late measurements."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.analysis.crlb import check_finite_information
from ewif_jax.fast.small import matmul
from ewif_jax.fast.sparse import dense
from ewif_jax.kernels import cholesky, gaussian
from ewif_jax.kernels.trees import choose
from ewif_jax.latency import on_time
from ewif_jax.models import Model, predict_measurement, predict_state
from ewif_jax.models.components import check_components, existing
from ewif_jax.streams import cast, checked_stream, float_dtype
from ewif_jax.types import Measurement, Numbers, Parameter, Params

Bound = tuple[Array, Array, Array]
"""What the recursions carry: the bound (n, n), the true states (R, n) and the time () it is for."""


def pcrlb(
    model: Model,
    params: Params,
    measurements: Measurement,
    truth: Numbers,
    *,
    start: Numbers,
    prior_cov: Parameter,
    t0: Numbers,
) -> Array:
    r"""The bound (T, n, n) on the error covariance after each measurement, in order of time.

    .. math::
        J_{k+1} = D_{22} - D_{12}' (D_{11} + J_k)^{-1} D_{12} \quad (64), \qquad
        D_{11} = E[F' Q^{-1} F], \quad D_{12} = -E[F'] Q^{-1}, \quad
        D_{22} = Q^{-1} + E[H' R^{-1} H] \quad (65)\text{-}(67)

    Pornsarayouth & Yamakita after Tichavsky et al. (1998), with F and H the Jacobians along the
    true trajectory. The expectations are averages over the given trajectories; one trajectory gives
    the bound along it. Computed for :math:`J^{-1}`, so that Q and the prior may be singular (Q not
    where F differs between trajectories).

    Args:
        model, params: the world.
        measurements: T of them, none earlier than the one before; their values are not used.
        truth: (T, n) or (R, T, n) true states at the measurements, in the units of the model's
            state.
        start: (n,) or (R, n) true states at t0.
        prior_cov: (n, n) covariance of what is known at t0, in products of those units.
        t0: seconds.

    Returns:
        (T, n, n) in products of the units of the state (m^2, m^2/s, ... for kinematic models); the
        square root of a diagonal element bounds an RMSE. NaN from a measurement on whose R is
        not known and singular.

    Reduces to: the covariance of `kalman` for a linear model; that of `extended` linearised at the
        truth for one trajectory.

    Deviations: (63) lacks the logarithm and the minus of the Fisher information, (62) the inverse
        of A. An average over trajectories that pass through a bearing sensor does not exist (the
        expectation of 1/r^2): give one trajectory at a time then.

    Raises:
        ValueError: wrong shapes; a prior_cov that is not PSD; times before t0 or that go back; a
            known R that is singular (an exact measurement has no finite information: give it a
            small variance).
    """
    many = jnp.ndim(truth) == 3
    truth, start = (x if many else jnp.asarray(x)[None] for x in (truth, start))
    stream, truth, first = _checked_inputs(model, params, measurements, truth, start, prior_cov, t0)
    time = checks.concrete_value(stream.time)
    in_order = time is None or np.all(np.diff(time) >= 0)
    checks.require(in_order, "measurements.time", "times that do not decrease", time)
    return _in_order(model, params, stream, truth, first)


def pcrlb_late(
    model: Model,
    params: Params,
    measurements: Measurement,
    truth: Numbers,
    *,
    start: Numbers,
    prior_cov: Parameter,
    t0: Numbers,
    times: Numbers,
) -> Array:
    r"""The bound (T, n, n) at each report, from the measurements that have arrived by then.

    The joint Fisher information of the states at the times of everything that has arrived,

    .. math::
        J = J_0 + \sum_j [F_j, -1]' Q_j^{-1} [F_j, -1] + \sum_l H_l' R_l^{-1} H_l,

    each measurement at its own time, is marginalised to the last of these states and predicted to
    the report: for report k the recursion of `pcrlb` over arrivals 0..k in order of time. Average
    it over trajectories where you have several.

    Args:
        model, params, start (n,), prior_cov, t0: as in `pcrlb`.
        measurements: T in their order of arrival.
        truth: (T, n) true states at the times of the measurements.
        times: (T,) seconds, when to report after arrival k.

    Returns:
        (T, n, n) in the units of `pcrlb`; NaN where a measurement that has arrived is newer than
        the report.

    Reduces to: `pcrlb` where nothing is late and the reports are at the measurements.

    Raises:
        ValueError: as in `pcrlb`, except that measurement times may go back.
    """
    arrived, truth, first = _checked_inputs(
        model,
        params,
        measurements,
        jnp.asarray(truth)[None],
        jnp.asarray(start)[None],
        prior_cov,
        t0,
    )
    checks.shape("times", times, (truth.shape[1],))
    checks.finite("times", times)
    times = jnp.asarray(times, truth.dtype)
    return _as_it_arrives(model, params, arrived, truth[0], first, times)


def pcrlb_equivalent(
    model: Model,
    params: Params,
    measurements: Measurement,
    truth: Numbers,
    *,
    start: Numbers,
    prior_cov: Parameter,
    t0: Numbers,
    times: Numbers,
) -> Array:
    r"""The published bound (T, n, n) for late measurements, which is not a bound: it is too high.

    A late measurement counts as one of the present state,

    .. math::
        h^* = h_l \circ f_{l,k} \quad (69), \qquad
        R^* = R + H^* Q(k, l) H^{*\prime} \quad (70),

    in the recursion of `pcrlb` over the reports (Pornsarayouth & Yamakita). The process noise since
    :math:`t_l` is taken to be unknown, as if nothing had been measured since; good filters do
    better. `pcrlb_late` is the bound.

    Args:
        model, params, start (n,), prior_cov, t0: as in `pcrlb`; motion must run backwards.
        measurements: T in their order of arrival.
        truth: (T, n) true states at `times`.
        times: (T,) report times in seconds, not decreasing, none earlier than its measurement.

    Returns:
        (T, n, n) in the units of `pcrlb`.

    Reduces to: `pcrlb` where nothing is late and the reports are at the measurements.

    Deviations: the printed minus in (70) makes the information indefinite; plus is meant.

    Raises:
        ValueError: as in `pcrlb_late`; report times that go back.
    """
    stream, truth, first = _checked_inputs(
        model,
        params,
        measurements,
        jnp.asarray(truth)[None],
        jnp.asarray(start)[None],
        prior_cov,
        t0,
    )
    checks.report_times(times, truth.shape[1])
    times = jnp.asarray(times, truth.dtype)
    return _equivalent_bound(model, params, stream, truth[0], first, times)


@partial(jax.jit, static_argnames="model")
def _in_order(
    model: Model, params: Params, stream: Measurement, truth: Array, first: Bound
) -> Array:
    def body(carry: tuple, now: tuple) -> tuple[tuple, Array]:
        cov, before, last = carry
        measurement, states = now
        moved = _moved_bound(model, params, cov, before, last, measurement.time)
        after = _informed_bound(moved, _expected_information(model, params, states, measurement))
        return (after, states, measurement.time), after

    return lax.scan(body, first, (stream, jnp.moveaxis(truth, 0, 1)))[1]


@partial(jax.jit, static_argnames="model")
def _as_it_arrives(
    model: Model, params: Params, arrived: Measurement, truth: Array, first: Bound, times: Array
) -> Array:
    # Sorted once; report k passes over what has not arrived by then. The bound of a late
    # measurement depends on all states between, so there is no shorter way than from the start.
    order = jnp.argsort(arrived.time, stable=True)
    stream, states = jax.tree.map(lambda x: x[order], (arrived, truth))

    def report(number: Array, time: Array) -> Array:
        def body(carry: tuple, now: tuple) -> tuple[tuple, None]:
            cov, before, last = carry
            measurement, state, place = now
            moved = _moved_bound(model, params, cov, before, last, measurement.time)
            after = _informed_bound(
                moved, _expected_information(model, params, state[None], measurement)
            )
            here = (after, state[None], measurement.time)
            return choose((place <= number) & jnp.any(measurement.mask), here, carry), None

        bound, _ = lax.scan(body, first, (stream, states, order))
        return jnp.where(time >= bound[2], _moved_bound(model, params, *bound, time), jnp.nan)

    return jax.vmap(report)(jnp.arange(times.shape[0]), times)


@partial(jax.jit, static_argnames="model")
def _equivalent_bound(
    model: Model, params: Params, stream: Measurement, truth: Array, first: Bound, times: Array
) -> Array:
    def body(carry: tuple, now: tuple) -> tuple[tuple, Array]:
        cov, before, last = carry
        measurement, state, time = now
        moved = _moved_bound(model, params, cov, before, last, time)
        there, back, _ = predict_state(model, params, state, time, measurement.time)
        noise = jnp.asarray(model.process_cov(params, measurement.time, time), cov.dtype)
        _, H, R = predict_measurement(model, params, there, measurement.sensor, measurement.time)
        seen = matmul(H, back)
        spread = R + matmul(matmul(seen, noise), seen.T)
        after = _informed_bound(moved, _measured_information(seen, spread, measurement.mask))
        return (after, state[None], time), after

    return lax.scan(body, first, (stream, truth, times))[1]


def _moved_bound(
    model: Model, params: Params, cov: Array, states: Array, t0: Array, t1: Array
) -> Array:
    """The bound after the motion of the true states (R, n) from t0 to t1.

    With F = E[F] + dF, the inverse of (64) is Q + E[F] (J + E[dF' Q^-1 dF])^-1 E[F]'.
    """
    _, F, Q = jax.vmap(lambda x: predict_state(model, params, x, t0, t1), out_axes=(0, 0, None))(
        states
    )
    F = dense(F)
    mean = F.mean(0)
    root = cholesky.factor(Q)
    apart = jax.vmap(lambda F: cholesky.forward(root, F - mean))(F)
    kept = _informed_bound(cov, jnp.einsum("rij,rik->jk", apart, apart) / F.shape[0])
    return matmul(matmul(mean, kept), mean.T) + Q


def _expected_information(
    model: Model, params: Params, states: Array, measurement: Measurement
) -> Array:
    """E[H' R^-1 H] over the true states (R, n)."""

    def one_state(x: Array) -> Array:
        _, H, R = predict_measurement(model, params, x, measurement.sensor, measurement.time)
        return _measured_information(dense(H), R, measurement.mask)

    return jax.vmap(one_state)(states).mean(0)


def _measured_information(H: Array, R: Array, mask: Array) -> Array:
    """H' R^-1 H over the components that exist; NaN where R has no inverse."""
    root = cholesky.factor(gaussian.mask_cov(R, mask))
    white = cholesky.forward(root, jnp.where(mask[:, None], H, 0))
    return jnp.where(root.full_rank, matmul(white.T, white), jnp.nan)


def _informed_bound(cov: Array, information: Array) -> Array:
    """(cov^-1 + information)^-1, where both may be singular."""
    # (P^-1 + L L')^-1 = P - P L (I + L' P L)^-1 L' P: neither P nor the information is inverted,
    # and the matrix that is has eigenvalues of at least 1.
    root = cholesky.factor(information).lower
    cross = matmul(root.T, cov)
    eye = jnp.eye(cov.shape[0], dtype=cov.dtype)
    spread = cholesky.factor(eye + matmul(cross, root))
    white = cholesky.forward(spread, cross)
    return cov - matmul(white.T, white)


def _checked_inputs(
    model: Model,
    params: Params,
    measurements: Measurement,
    truth: Numbers,
    start: Numbers,
    prior_cov: Parameter,
    t0: Numbers,
) -> tuple[Measurement, Array, Bound]:
    """The measurements, the truth (R, T, n) and the bound at t0, all in the float dtype of the
    truth, after what can be known is checked."""
    checked_stream(measurements)
    measurements = on_time(model, None, params, measurements)
    checks.sensors(measurements, model.sensors)
    check_components(model, measurements)
    check_finite_information(model, params, measurements)
    steps = jnp.shape(measurements.time)[0]
    checks.shape("truth", truth, ("R", steps, "n"))
    runs, _, n = jnp.shape(truth)
    checks.finite("truth", truth)
    checks.shape("start", start, (runs, n))
    checks.finite("start", start)
    checks.shape("prior_cov", prior_cov, (n, n))
    checks.psd("prior_cov", prior_cov)
    checks.shape("t0", t0, ())
    time, begin = checks.concrete_value(measurements.time), checks.concrete_value(t0)
    after = time is None or begin is None or time.min() >= begin
    checks.require(after, "measurements.time", f"times from t0 = {begin} on", time)
    dtype = float_dtype(truth)
    truth, start, cov, t0 = (jnp.asarray(x, dtype) for x in (truth, start, prior_cov, t0))
    return cast(existing(model, measurements), dtype), truth, (cov, start, t0)
