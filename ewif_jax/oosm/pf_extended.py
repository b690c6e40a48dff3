"""Particles that remember their paths, so that a late state is drawn between two known ones."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.fast.small import matvec
from ewif_jax.fast.sparse import dense
from ewif_jax.kernels import cholesky, retrodiction
from ewif_jax.kernels.resampling import Resampling
from ewif_jax.kernels.trees import copies
from ewif_jax.models import Model, predict_state
from ewif_jax.models.angles import state_difference
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions import particles as form
from ewif_jax.recursions import weighing
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.particles import ParticleState
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Params


class PathState(NamedTuple):
    """time (), particles (n, N), log_weights (N,), key; used (): whether this time has taken a
    measurement; past_times (L,) and past (L, n, N): where each particle was at the last L times,
    newest first."""

    time: Array
    particles: Array
    log_weights: Array
    key: Array
    used: Array
    past_times: Array
    past: Array


@from_recipe
def pf_extended(
    model: Model,
    particles: int,
    lag: int,
    resampling: Resampling = "systematic",
    ess_threshold: float = 0.5,
    collapse: float | None = 100.0,
) -> Estimator:
    r"""The bootstrap filter that draws the state at a late time from each particle's own path.

    With a and c the stored times on either side of :math:`\tau` (c may be now),

    .. math::
        w^i &\propto w^i\, p(y_\tau | x_\tau^i), \qquad
            x_\tau^i \sim N(\hat x_\tau^i, \Sigma_\tau^i) \quad (9), (13) \\
        \hat x_\tau^i &= f_{\tau,a}(x_a^i)
            + K (x_c^i - f_{c,\tau}(f_{\tau,a}(x_a^i))) \quad (14) \\
        \Sigma_\tau^i &= Q_{\tau,a} - K F_{c,\tau} Q_{\tau,a}, \qquad
            K = Q_{\tau,a} F_{c,\tau}' (F_{c,\tau} Q_{\tau,a} F_{c,\tau}' + Q_{c,\tau})^{-1}
            \quad (15), (16)

    with F the Jacobian at each particle: Orguner & Gustafsson (8)-(17), which extends Orton & Marrs
    (2005) to nonlinear motion.

    Args:
        model: linear or not; its process noise must compose over parts of an interval. Q may be
            singular; R must be positive definite (else every measurement is `REJECTED`).
        particles: N >= 2.
        lag: how many past times are stored, >= 1; each takes n N numbers. A measurement older than
            all of them, or than t0, is `TOO_LATE`. Times without a used measurement are not stored.
        resampling, ess_threshold: as in `bootstrap`. The paths are resampled with the particles.
        collapse: as in `pf_retrodict`.

    As N grows it converges to the posterior of a linear model, and of a nonlinear one as far as
    (14)-(17) hold. A state drawn at a late time is not remembered: two late measurements between
    the same stored times are taken as if their states were independent given those.

    Gradients as in `bootstrap`.

    Reduces to: `bootstrap` in sequence and at delay 0.

    Deviations: resampling, where too few particles count, waits until the filter moves on or the
        next late measurement draws its states, as in `pf_retrodict`.

    Raises:
        ValueError: fewer than 2 particles; lag < 1; collapse < 1; `init` without a key or a prior.
    """
    kind = form.cloud(model, particles, resampling, ess_threshold)
    collapse = form.collapse_factor(collapse)
    lag = checks.whole("lag", lag, 1)

    in_order = jnp.arange(kind.particles, dtype=jnp.int32)

    def start(params: Params, prior: Gaussian, t0: Array, key: Array) -> PathState:
        del params
        first = form.drawn_particles(kind, prior, t0, key)
        times, past = copies((first.time, first.particles), lag)
        return PathState(*first, jnp.asarray(False), times, past)

    def move(params: Params, state: PathState, time: Array) -> PathState:
        def go(old: PathState) -> PathState:
            # Both tables, with the old time in front and without, are views of one that is
            # resampled once.
            paths = jnp.concatenate([old.particles[None], old.past])
            new, paths = form.step_ahead(kind, params, old, time, paths)
            times = jnp.concatenate([old.time[None], old.past_times])
            kept = (times[:-1], paths[:-1]), (times[1:], paths[1:])
            times, past = jax.tree.map(lambda a, b: jnp.where(old.used, a, b), *kept)
            return new._replace(used=jnp.asarray(False), past_times=times, past=past)

        return form.if_later(state, time, go)

    def within_lag(params: Params, state: PathState, time: Array) -> Array:
        del params
        return time >= state.past_times[-1]

    def measure(
        params: Params, state: PathState, measurement: Measurement
    ) -> tuple[PathState, Info]:
        def drawn_between(cloud: ParticleState) -> tuple[ParticleState, Array, Array]:
            cloud, order, key = form.ready_to_draw(kind, cloud, in_order)
            ends = state._replace(particles=cloud.particles)
            return cloud, _drawn_between(model, params, ends, order, measurement.time, key), order

        cloud, there, order = lax.cond(
            weighing.is_late(state, measurement),
            drawn_between,
            lambda cloud: (cloud, cloud.particles, in_order),
            ParticleState(*state[:4]),
        )
        seen = weighing.look_of_cloud(model, params, there, cloud.log_weights, measurement)
        log_weights, info = weighing.weigh(cloud, seen, measurement, collapse)
        cloud = cloud._replace(log_weights=log_weights)
        # The paths follow at the end, so that no branch has to copy them.
        past = lax.cond(
            jnp.any(order != in_order), lambda x: x[..., order], lambda x: x, state.past
        )
        return state._replace(**cloud._asdict(), used=jnp.asarray(True), past=past), info

    recursion = Recursion(
        "pf_extended", start, move, measure, form.estimator_of_cloud(model), within_lag
    )
    recursion = recursion._replace(draws=True, estimated=("particles",))
    return estimator_from(recursion._replace(model=model))


def _drawn_between(
    model: Model, params: Params, state: PathState, order: Array, time: Array, key: Array
) -> Array:
    """Draws of the states at `time` (n, N), given where each particle was before and after: those
    now are copies, in this `order` (N,), of those that the stored paths belong to."""
    times = jnp.concatenate([state.time[None], state.past_times])
    # Times fall along the table, so the number of later ones is the index of the last one not
    # later.
    newer = jnp.clip(jnp.sum(times > time), 1, state.past_times.shape[0])
    start, end = times[newer], times[newer - 1]
    before = state.past[newer - 1][:, order]
    between = state.past[jnp.maximum(newer - 2, 0)][:, order]
    after = jnp.where(newer == 1, state.particles, between)
    time = jnp.clip(time, start, end)

    def draw(x: Array, target: Array, normals: Array) -> Array:
        there, _, Q_before = predict_state(model, params, x, start, time)
        arrived, F, Q_after = predict_state(model, params, there, time, end)
        gain, left_over = retrodiction.bridge(Q_before, dense(F), Q_after)
        root = cholesky.factor(left_over).lower
        return (
            there + matvec(gain, state_difference(model, target, arrived)) + matvec(root, normals)
        )

    normals = jax.random.normal(key, state.particles.shape, state.particles.dtype)
    return jax.vmap(draw, -1, -1)(before, after, normals)
