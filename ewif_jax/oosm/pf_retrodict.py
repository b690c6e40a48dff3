"""Particles moved back to the time of a late measurement."""

import jax.numpy as jnp
from jax import Array, lax

from ewif_jax.kernels.resampling import Resampling
from ewif_jax.models import Model
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions import particles as form
from ewif_jax.recursions import weighing
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.particles import ParticleState
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Params


@from_recipe
def pf_retrodict(
    model: Model,
    particles: int,
    resampling: Resampling = "systematic",
    ess_threshold: float = 0.5,
    collapse: float | None = 100.0,
) -> Estimator:
    r"""The bootstrap filter that weighs by a late measurement with particles moved back to it.

    .. math::
        x^i(l) = f_{l,k}(x^i(k) - v^i), \quad v^i \sim N(0, Q(k, l)) \quad (88), (89) \qquad
        w^i(k|l^+) \propto w^i(k)\, p(z(l) | x^i(l)) \quad (90)

    Mallick, Kirubarajan & Arulampalam (2002) as in Pornsarayouth & Yamakita (87)-(92). Nothing is
    stored, so a late measurement of any age is used.

    The noise drawn in (88) knows nothing of the noise that really acted, so more particles do not
    lead to the posterior: the limit for a linear model is a Kalman update with
    :math:`H^* = H F^{-1}, R^* = R + H^* Q H^{*\prime}`, which reports too small a variance and is
    unstable at long delays. Use `pf_extended` or `pf_fixed_point` where that matters.

    Args:
        model: linear or not; it must allow motion back in time, and its process noise must compose
            over parts of an interval. R must be positive definite (else every measurement is
            `REJECTED`).
        particles: N >= 2.
        resampling, ess_threshold: as in `bootstrap`.
        collapse: a late measurement that divides the effective sample size by more than this is
            `REJECTED` (Orguner & Gustafsson, section IV); None: never.

    Gradients as in `bootstrap`.

    Reduces to: `bootstrap` in sequence and at delay 0.

    Raises:
        ValueError: fewer than 2 particles; collapse < 1; `init` without a key or a prior.

    Deviations: (91) prints x(k|l) for x(k|l+). Resampling (step 8), where too few particles count,
        waits until the filter moves on or the next late measurement draws its noise, so that
        estimates do not carry its noise: of measurements that arrive together each meets a cloud
        that was resampled after the one before.
    """
    kind = form.cloud(model, particles, resampling, ess_threshold)
    collapse = form.collapse_factor(collapse)

    def start(params: Params, prior: Gaussian, t0: Array, key: Array) -> ParticleState:
        del params
        return form.drawn_particles(kind, prior, t0, key)

    def any_age(params: Params, state: ParticleState, time: Array) -> Array:
        del params, state, time
        return jnp.asarray(True)

    def measure(
        params: Params, state: ParticleState, measurement: Measurement
    ) -> tuple[ParticleState, Info]:
        def moved_back(state: ParticleState) -> tuple[ParticleState, Array]:
            state, _, key = form.ready_to_draw(kind, state)
            then = jnp.minimum(measurement.time, state.time)
            Q = jnp.asarray(model.process_cov(params, then, state.time), state.time.dtype)
            # The noise comes off first and the motion after it, as (89) has them: x(k) = f(x(l)) +
            # v.
            origin = state.particles - form.gaussian_draws(key, Q, particles)
            return state, form.transported(model, params, origin, state.time, then)

        is_late = weighing.is_late(state, measurement)
        drawn, there = lax.cond(is_late, moved_back, lambda s: (s, s.particles), state)
        seen = weighing.look_of_cloud(model, params, there, drawn.log_weights, measurement)
        log_weights, info = weighing.weigh(drawn, seen, measurement, collapse)
        return drawn._replace(log_weights=log_weights), info

    recursion = Recursion(
        "pf_retrodict", start, form.mover(kind), measure, form.estimator_of_cloud(model)
    )
    recursion = recursion._replace(reach=any_age, draws=True, estimated=("particles",))
    return estimator_from(recursion._replace(model=model))
