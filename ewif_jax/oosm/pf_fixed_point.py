"""A particle filter that needs no old particles: auxiliary fixed-point smoothers."""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.fast.small import matmul
from ewif_jax.fast.sparse import dense
from ewif_jax.kernels import gaussian, symmetric
from ewif_jax.kernels.resampling import Resampling
from ewif_jax.kernels.trees import choose, copies
from ewif_jax.models import Model, predict_measurement
from ewif_jax.oosm.parts.history import last_before
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions import particles as form
from ewif_jax.recursions import weighing
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.covariance import CovarianceState
from ewif_jax.recursions.fixed_point import Conditional, fixed_point, given
from ewif_jax.recursions.innovations import are_finite
from ewif_jax.recursions.particle_smoother import lines, look_back
from ewif_jax.recursions.sigma_points import SigmaPoints, transform
from ewif_jax.recursions.weighing import SeenByCloud
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Parameter, Params

Smoother = Literal["eks", "uks", "ps"]


class SummaryState(NamedTuple):
    """time (), particles (n, N), log_weights (N,), key; past: time (L+1,), mean (L+1, n), cov
    (L+1, packed) after each of the last updates, newest first, and measured: what was measured
    then."""

    time: Array
    particles: Array
    log_weights: Array
    key: Array
    past: CovarianceState
    measured: Measurement


@from_recipe
def pf_fixed_point(
    model: Model,
    particles: int,
    lag: int,
    smoother: Smoother = "eks",
    smoother_particles: int | None = None,
    resampling: Resampling = "systematic",
    ess_threshold: float = 0.5,
    collapse: float | None = 100.0,
    ut_alpha: Parameter = 1.0,
    ut_beta: Parameter = 0.0,
    ut_kappa: Parameter = 0.0,
) -> Estimator:
    r"""The bootstrap filter that smooths back to a late measurement from means and covariances.

    .. math::
        w^i \propto w^i\, p(y_\tau | x_k^i, y_{0:k}) \quad (21), \qquad
        p(y_\tau | x_k^i, y_{0:k}) = \int p(y_\tau | x_\tau)\, p(x_\tau | x_k^i, y_{0:k-1})\,
            dx_\tau \quad (23)

    Orguner & Gustafsson (18)-(49). The smoothed density is a Gaussian with (27)-(29) for the
    integral, by linearisation ("eks") or by sigma points ("uks"), see `recursions.fixed_point`; or
    it is `smoother_particles` weighted points ("ps"), see `recursions.particle_smoother`. One
    smoother runs for all particles; each then costs one product ("eks", "uks") or one row of
    densities ("ps").

    Args:
        model: linear or not; its process noise must compose over parts of an interval. R must be
            positive definite (else every measurement in sequence is `REJECTED`, and with "ps" every
            late one), and for "ps" Q too (a singular Q has no density: every late measurement is
            then `REJECTED`).
        particles: N >= 2.
        lag: how many in-sequence measurements are stored, >= 1, each with the mean and covariance
            after it: what the state holds does not grow with lag times N. A measurement older than
            all of them, or than t0, is `TOO_LATE`.
        smoother: "eks", "uks" or "ps".
        smoother_particles: M >= 2 for "ps"; default N / 10. They are resampled (systematic) where
            fewer than M / 2 of them count, whatever `resampling` says of the filter's own.
        resampling, ess_threshold: as in `bootstrap`.
        collapse: as in `pf_retrodict`.
        ut_alpha, ut_beta, ut_kappa: of "uks", as in `unscented`. The paper has 1e-3, 2 and 0, which
            float32 cannot carry (refused).

    For one late measurement, and for several of which the earlier are part of the stored
    summaries, all three converge to the posterior of a linear model ("ps" as M grows too);
    otherwise what an earlier late measurement said about the time between is forgotten. A summary
    is one Gaussian: where the filtered density has several modes, so much is lost.

    Gradients as in `bootstrap`.

    Reduces to: `bootstrap` in sequence and at delay 0.

    Raises:
        ValueError: fewer than 2 particles; lag < 1; an unknown smoother; collapse < 1; `init`
            without a key or a prior.

    Deviations: as in the two smoothers. A late measurement in the last interval sees x(k) as a
        measurement of x(tau), not of x(k-1) as Remark 2 prints. The measurement (40)-(42) of
        y(k-1) and x(k) together is taken as an update with y(k-1), after which the motion to k is
        made linear around the updated state (the same for linear models). "uks" has sigma points
        in the smoother; the integral (27)-(29) is by the Jacobian of h for both.
    """
    kind = form.cloud(model, particles, resampling, ess_threshold)
    collapse = form.collapse_factor(collapse)
    slots = checks.whole("lag", lag, 1) + 1
    checks.require(smoother in ("eks", "uks", "ps"), "smoother", "'eks', 'uks' or 'ps'", smoother)
    few = max(particles // 10, 2) if smoother_particles is None else smoother_particles
    few = checks.whole("smoother_particles", few, 2)
    points = SigmaPoints(ut_alpha, ut_beta, ut_kappa) if smoother == "uks" else None

    def start(params: Params, prior: Gaussian, t0: Array, key: Array) -> SummaryState:
        first = form.drawn_particles(kind, prior, t0, key)
        if points is not None:
            transform(points, params, 2 * prior.mean.shape[0], t0.dtype)
        told = CovarianceState(t0, prior.mean, symmetric.pack(prior.cov))
        m = _value_size(model, params, told)
        nothing = Measurement(
            t0, jnp.zeros(m, t0.dtype), jnp.zeros((), jnp.int32), jnp.zeros(m, bool)
        )
        past, measured = copies((told, nothing), slots)
        return SummaryState(*first, past, measured)

    def within_lag(params: Params, state: SummaryState, time: Array) -> Array:
        del params
        return time >= state.past.time[-1]

    def measure(
        params: Params, state: SummaryState, measurement: Measurement
    ) -> tuple[SummaryState, Info]:
        def in_sequence(state: SummaryState) -> tuple[SeenByCloud, Array]:
            weights = state.log_weights
            return weighing.look_of_cloud(
                model, params, state.particles, weights, measurement
            ), state.key

        def smoothed(state: SummaryState) -> tuple[SeenByCloud, Array]:
            key, ours = jax.random.split(state.key)
            stored = jax.tree.map(lambda x: x[::-1], state.measured)
            _, first = last_before(state.past, measurement.time)
            tau = jnp.clip(measurement.time, first.time, state.time)
            if smoother == "ps":
                last = lines(model, params, first, tau, stored, state.time, few, ours)
                return look_back(model, params, last, state.time, state, measurement), key
            past = fixed_point(model, points, params, first, tau, stored, state.time)
            return _look_through(model, params, past, state, measurement), key

        is_late = weighing.is_late(state, measurement)
        seen, key = lax.cond(is_late, smoothed, in_sequence, state)
        log_weights, info = weighing.weigh(state, seen, measurement, collapse)
        weighed = state._replace(log_weights=log_weights, key=key)
        return _remembered_summary(model, weighed, measurement), info

    recursion = Recursion(
        "pf_fixed_point", start, form.mover(kind), measure, form.estimator_of_cloud(model)
    )
    recursion = recursion._replace(reach=within_lag, draws=True, estimated=("particles",))
    return estimator_from(recursion._replace(model=model))


def _value_size(model: Model, params: Params, at: CovarianceState) -> int:
    """How many components a measurement has."""
    sensor = jnp.zeros((), jnp.int32)
    return jax.eval_shape(lambda: model.observe(params, at.mean, sensor, at.time)).shape[0]


def _look_through(
    model: Model, params: Params, past: Conditional, state: SummaryState, measurement: Measurement
) -> SeenByCloud:
    """A late measurement as it is seen by particles now, through the state at its time."""
    time, value, sensor, mask = measurement

    def seen_through(x: Array) -> tuple[Array, Array, Array, Array, Array]:
        there = given(model, past, x)
        predicted, H, R = predict_measurement(model, params, there.mean, sensor, time)
        checks.shape("measurement.value", value, (R.shape[0],))
        difference = jnp.where(mask, model.residual(value, predicted, sensor), 0)
        cov = gaussian.mask_cov(matmul(matmul(H, there.cov), H.T) + R, mask)
        good = are_finite(difference, cov, mask)
        difference, cov = jnp.where(good, difference, 0), jnp.where(good, cov, R)
        innovation = gaussian.innovate(difference, dense(H), cov, mask)
        return there.mean, predicted, innovation.cov, gaussian.log_density(innovation, mask), good

    there, predicted, cov, log_density, good = jax.vmap(seen_through, -1, -1)(state.particles)
    innovation, spread = weighing.averaged_innovation(
        model, params, there, predicted, good, state.log_weights, measurement
    )
    cov = cov @ weighing.shares(state.log_weights, good) + spread
    return SeenByCloud(
        jnp.where(good, log_density, -jnp.inf), innovation, weighing.judged_cov(cov, good)
    )


def _remembered_summary(
    model: Model, state: SummaryState, measurement: Measurement
) -> SummaryState:
    """The state with its present mean and covariance in place of those of the same time, or, after
    an in-sequence measurement or at a new time, in front of them."""
    mean, cov = form.summary(model, state)
    now = CovarianceState(state.time, mean, symmetric.pack(cov))
    late = measurement.time < state.time
    taken = measurement._replace(time=state.time, mask=measurement.mask & ~late)
    # A second late measurement at one filter time rewrites the summary: two entries of one time
    # would count the interval of no length as a step of the smoother.
    again = late & (state.past.time[0] == state.time)
    pushed = jax.tree.map(
        lambda row, table: jnp.concatenate([row[None], table[:-1]]),
        (now, taken),
        (state.past, state.measured),
    )
    rewritten = jax.tree.map(lambda row, table: table.at[0].set(row), now, state.past)
    past, measured = choose(again, (rewritten, state.measured), pushed)
    return state._replace(past=past, measured=measured)
