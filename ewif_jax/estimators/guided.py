"""The guided particle filter: particles are drawn with the measurement in view."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.small import matmul, matvec
from ewif_jax.fast.sparse import dense
from ewif_jax.kernels import cholesky
from ewif_jax.kernels.resampling import Resampling
from ewif_jax.models import Model, predict_measurement
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions import particles as form
from ewif_jax.recursions import weighing
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Params


class GuidedState(NamedTuple):
    """time (), particles (n, N), log_weights (N,), key; origins (n, N): where the particles are
    without the noise of the last motion; root (n, n): a factor of the covariance of that noise,
    zero once a measurement has been used."""

    time: Array
    particles: Array
    log_weights: Array
    key: Array
    origins: Array
    root: Array


class Proposal(NamedTuple):
    """Of each particle: particles (n, N) as drawn anew, excess (N,): log density of the motion
    less that of the draw, and evidence (N,): log density of the measurement before the draw, if
    the sensor is linear, both less what all particles have in common."""

    particles: Array
    excess: Array
    evidence: Array


@from_recipe
def guided(
    model: Model,
    particles: int,
    resampling: Resampling = "systematic",
    ess_threshold: float = 0.5,
) -> Estimator:
    r"""The particle filter that moves each particle to where the measurement wants it.

    With :math:`m^i = f(x_{k-1}^i)`, :math:`H^i = \partial h / \partial x |_{m^i}` and
    :math:`S^i = H^i Q H^{i\prime} + R`

    .. math::
        x_k^i &\sim N\big( m^i + K^i (z - h(m^i)),\; (I - K^i H^i) Q \big), \quad
            K^i = Q H^{i\prime} (S^i)^{-1} \\
        w_k^i &\propto w_{k-1}^i\, \frac{p(z | x_k^i)\, N(x_k^i; m^i, Q)}{q(x_k^i)}
            \quad \big( = w_{k-1}^i\, N(z; h(m^i), S^i) \text{ for a linear sensor} \big)

    (Doucet, Godsill & Andrieu 2000, Statistics and Computing 10, 197, sections II-B and II-D). For
    a linear sensor the draw q is the best there is, and the weights do not depend on it; otherwise
    h is a straight line around each :math:`m^i`, and the weights make up for it. Where the sensor
    is precise and the process noise is not, few particles do what takes `bootstrap` many. Where a
    sensor is strongly curved within the process noise the draws may miss what is likely, and
    `bootstrap` is better.

    Until a measurement comes the particles are drawn from the motion alone, which is what
    `estimate` reports; those draws are then replaced. A measurement at t0 guides the draws from
    the prior, a second one at the same time only weighs them.

    Args:
        model: linear or not, with Gaussian noise. Q and the prior's covariance may be singular or
            zero; R must be positive definite (else every measurement is `REJECTED`).
        particles: N >= 2.
        resampling: "systematic" or "stratified", as in `bootstrap`.
        ess_threshold: the filter resamples before it moves on when fewer than this share of the
            particles count.

    Late measurements (`TOO_LATE`; use them with `replay`), what no particle explains, keys and
    gradients as in `bootstrap`. `Info.innovation` and its covariance are those of the prediction;
    the log likelihood is the logarithm of the mean weight, so that of a stream is the logarithm of
    an unbiased estimate of the likelihood. A particle at which h or its slope is not a number is
    drawn as in `bootstrap`.

    Reduces to: `bootstrap` without process noise; `kalman` on a linear model as N grows, with
        errors of order 1 / sqrt(N).

    Raises:
        ValueError: fewer than 2 particles; an unknown scheme; `init` without a key or a prior.
    """
    kind = form.cloud(model, particles, resampling, ess_threshold)

    def start(params: Params, prior: Gaussian, t0: Array, key: Array) -> GuidedState:
        del params
        first = form.drawn_particles(kind, prior, t0, key)
        origins = jnp.broadcast_to(prior.mean[:, None], first.particles.shape)
        return GuidedState(*first, origins, cholesky.factor(prior.cov).lower)

    def ahead(params: Params, state: GuidedState, time: Array) -> GuidedState:
        key, first, second = jax.random.split(state.key, 3)
        state, _ = form.renewed(kind, first, state)
        origins = form.transported(model, params, state.particles, state.time, time)
        Q = jnp.asarray(model.process_cov(params, state.time, time), origins.dtype)
        checks.shape("Q", Q, (origins.shape[0],) * 2)
        root = cholesky.factor(Q).lower
        normals = jax.random.normal(second, origins.shape, origins.dtype)
        drawn = origins + matmul(root, normals)
        return GuidedState(time, drawn, state.log_weights, key, origins, root)

    def move(params: Params, state: GuidedState, time: Array) -> GuidedState:
        return form.if_later(state, time, lambda old: ahead(params, old, time))

    def measure(
        params: Params, state: GuidedState, measurement: Measurement
    ) -> tuple[GuidedState, Info]:
        key, ours = jax.random.split(state.key)
        # One R for all, and for both looks, where it depends on the state.
        cloud = state.particles, state.log_weights
        noise = weighing.compared_cloud(model, params, *cloud, measurement)
        seen = weighing.look_of_cloud(model, params, *cloud, measurement)
        drawn = _proposed(model, params, state, measurement, noise.factor, ours)
        found = weighing.compared_cloud(
            model, params, drawn.particles, state.log_weights, measurement
        )._replace(R=noise.R, factor=noise.factor)
        if model.linear is not None:
            density = _common_density(found, measurement.mask) + drawn.evidence
        else:
            density = weighing.log_density(found, measurement.mask) + drawn.excess
        # Not a number is an impossible particle, in the way of no other.
        density = jnp.where(jnp.isfinite(density), density, -jnp.inf)
        log_weights, info = weighing.weigh(state, seen._replace(log_density=density), measurement)
        root = jnp.zeros_like(state.root)
        new = GuidedState(state.time, drawn.particles, log_weights, key, drawn.particles, root)
        return new, info

    recursion = Recursion(
        "guided", start, move, measure, form.estimator_of_cloud(model), model=model
    )
    return estimator_from(recursion._replace(draws=True, estimated=("particles",)))


def _proposed(
    model: Model,
    params: Params,
    state: GuidedState,
    measurement: Measurement,
    noise: cholesky.Factor,
    key: Array,
) -> Proposal:
    """The particles drawn with the measurement in view.

    A particle is origin + L u with L L' = Q and u standard normal: nothing divides by Q. With
    E = R^-1/2 H L the draw of u has the covariance (I + E'E)^-1, which is regular whatever E is,
    and the mean (I + E'E)^-1 E' R^-1/2 (z - h).
    """
    time, value, sensor, mask = measurement
    n = state.root.shape[0]
    normals = jax.random.normal(key, state.origins.shape, state.origins.dtype)

    def draw(origin: Array, normal: Array) -> Proposal:
        predicted, H, _ = predict_measurement(model, params, origin, sensor, time)
        difference = jnp.where(mask, model.residual(value, predicted, sensor), 0)
        slope = jnp.where(mask[:, None], matmul(dense(H), state.root), 0)
        fine = jnp.all(jnp.isfinite(jnp.square(difference))) & jnp.all(jnp.isfinite(slope))
        E = cholesky.forward(noise, jnp.where(fine, slope, 0))
        white = cholesky.forward(noise, jnp.where(fine, difference, 0))
        narrowed = cholesky.factor(jnp.eye(n, dtype=E.dtype) + matmul(E.T, E))
        shift = cholesky.solve(narrowed, matvec(E.T, white))
        u = shift + cholesky.backward(narrowed, normal)
        half_log_det = cholesky.half_log_det(narrowed)
        squares = jnp.sum(jnp.square(normal)) - jnp.sum(jnp.square(u))
        # What is left over and what the draw makes up for: a sum of squares, nothing subtracted.
        misfit = jnp.sum(jnp.square(white - matvec(E, shift))) + jnp.sum(jnp.square(shift))
        evidence = jnp.where(fine, -misfit / 2 - half_log_det, -jnp.inf)
        return Proposal(origin + matvec(state.root, u), squares / 2 - half_log_det, evidence)

    return jax.vmap(draw, -1, -1)(state.origins, normals)


def _common_density(found: weighing.ComparedCloud, mask: Array) -> Array:
    """What the log densities of all particles have in common (), -inf for a singular R."""
    size = jnp.sum(mask).astype(found.R.dtype) * jnp.log(jnp.asarray(2 * jnp.pi, found.R.dtype))
    density = -0.5 * size - cholesky.half_log_det(found.factor)
    return jnp.where(found.factor.full_rank, density, -jnp.inf)
