"""What particle filters share: drawing, moving and resampling a cloud of particles.

Particles are the last axis everywhere, so that what a model computes for one state becomes one
operation on contiguous rows.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.fast.small import matmul
from ewif_jax.kernels import cholesky, symmetric
from ewif_jax.kernels.resampling import Resampling, ancestors, effective_sample_size
from ewif_jax.models import Model
from ewif_jax.models.angles import Angles, centre_of, wrapped_state
from ewif_jax.recursions.contract import Report
from ewif_jax.types import Gaussian, Params, PyTree, State


class ParticleState(NamedTuple):
    """time (), particles (n, N), log_weights (N,) that sum to one, key."""

    time: Array
    particles: Array
    log_weights: Array
    key: Array


class Cloud(NamedTuple):
    """How a cloud is kept: the model, how many particles, and when and how they are resampled."""

    model: Model
    particles: int
    resampling: Resampling
    ess_threshold: float


ParticleLike = TypeVar("ParticleLike", bound=Any)
"""A NamedTuple that begins with the fields of `ParticleState`."""


def cloud(model: Model, particles: int, resampling: Resampling, ess_threshold: float) -> Cloud:
    """A `Cloud` of checked settings."""
    checks.require(isinstance(model, Model), "model", "a Model", type(model).__name__)
    checks.whole("particles", particles, 2)
    offered = resampling in ("systematic", "stratified")
    checks.require(offered, "resampling", "'systematic' or 'stratified'", repr(resampling))
    checks.at_least("ess_threshold", ess_threshold, 0.0)
    return Cloud(model, particles, resampling, ess_threshold)


def collapse_factor(collapse: float | None) -> float | None:
    """`collapse` if it is None or a factor >= 1."""
    return None if collapse is None else float(checks.at_least("collapse", collapse, 1.0))


def drawn_particles(kind: Cloud, prior: Gaussian, t0: Array, key: Array) -> ParticleState:
    """Equally weighted particles drawn from the prior, whose covariance may be singular."""
    N, dtype = kind.particles, t0.dtype
    key, ours = jax.random.split(key)
    particles = prior.mean[:, None] + gaussian_draws(ours, prior.cov, N)
    log_weights = jnp.full(N, -jnp.log(jnp.asarray(N, dtype)), dtype)
    return ParticleState(t0, particles, log_weights, key)


def gaussian_draws(key: Array, cov: Array, count: int) -> Array:
    """(n, count) draws from N(0, cov), cov (n, n) singular or not."""
    # The factor skips pivots that are zero, so that a singular covariance (a constant velocity
    # driven by one acceleration) needs no small noise added to it.
    normals = jax.random.normal(key, (cov.shape[0], count), cov.dtype)
    return matmul(cholesky.factor(cov).lower, normals)


def moved_particles(
    model: Model, params: Params, particles: Array, key: Array, t0: Array, t1: Array
) -> tuple[Array, Array]:
    """Particles (n, N) at t1 >= t0 without their process noise, and with it."""
    still = transported(model, params, particles, t0, t1)
    Q = jnp.asarray(model.process_cov(params, t0, t1), particles.dtype)
    checks.shape("Q", Q, (particles.shape[0],) * 2)
    return still, still + gaussian_draws(key, Q, particles.shape[1])


def transported(model: Model, params: Params, particles: Array, t0: Array, t1: Array) -> Array:
    """Particles (n, N) moved from t0 to t1, in either direction, without noise."""

    def move(x: Array) -> Array:
        return jnp.asarray(model.transition(params, x, t0, t1), x.dtype)

    return jax.vmap(move, -1, -1)(particles)


def mover(kind: Cloud) -> Callable[[Any, ParticleLike, Array], ParticleLike]:
    """The `move` of a recursion whose particles keep nothing of their past."""

    def move(params: Params, state: ParticleLike, time: Array) -> ParticleLike:
        return if_later(state, time, lambda old: step_ahead(kind, params, old, time)[0])

    return move


def if_later(
    state: ParticleLike, time: Array, go: Callable[[ParticleLike], ParticleLike]
) -> ParticleLike:
    """`go(state)` if `time` is later than the state's, else the state, which is then not moved by
    noise of no variance: keys are used up, and weights spent, by moving only."""
    return lax.cond(time > state.time, go, lambda old: old, state)


def step_ahead(
    kind: Cloud, params: Params, state: State, time: Array, along: PyTree = ()
) -> tuple[Any, Any]:
    """The state at a later `time`, and what goes along with the particles (pytrees of arrays with
    the particles as the last axis), both resampled first if too few particles count."""
    # Resampled before the motion, not after the update: copies then part at once by their own
    # noise, and the estimate is made with the weights before resampling, which has less variance.
    key, first, second = jax.random.split(state.key, 3)
    state, along = renewed(kind, first, state, along)
    _, particles = moved_particles(kind.model, params, state.particles, second, state.time, time)
    return state._replace(time=time, particles=particles, key=key), along


def renewed(
    kind: Cloud, key: Array, state: ParticleLike, along: PyTree = ()
) -> tuple[ParticleLike, Any]:
    """The state, and what goes along with its particles, resampled if too few of them count."""
    least = kind.ess_threshold * kind.particles
    (particles, along), log_weights = refreshed(
        key, (state.particles, along), state.log_weights, least, kind.resampling
    )
    return state._replace(particles=particles, log_weights=log_weights), along


def ready_to_draw(
    kind: Cloud, state: ParticleLike, along: PyTree = ()
) -> tuple[ParticleLike, Any, Array]:
    """The state before new noise is drawn for a late measurement, what goes along with its
    particles, and the key of that noise.

    Copies are worth having where each draws its own noise, so a cloud that measurements at this
    time have thinned out is resampled first. What was estimated before carries no noise of it.
    """
    key, ours = jax.random.split(state.key)
    state, along = renewed(kind, jax.random.fold_in(ours, 1), state, along)
    return state._replace(key=key), along, ours


def refreshed(
    key: Array, cloud: PyTree, log_weights: Array, least: float, method: Resampling = "systematic"
) -> tuple[Any, Array]:
    """`cloud` and its log weights, resampled if fewer than `least` particles count."""
    few = effective_sample_size(log_weights) < least
    return lax.cond(
        few,
        lambda cloud, log_weights: resampled(key, cloud, log_weights, method),
        lambda cloud, log_weights: (cloud, log_weights),
        cloud,
        log_weights,
    )


def resampled(
    key: Array, cloud: PyTree, log_weights: Array, method: Resampling
) -> tuple[Any, Array]:
    """Copies of the particles (a pytree, particles last) by their weights, and equal log weights.

    The new weights have the value 1 / N and the derivative of the old: their relative change, w /
    stop_gradient(w) (Scibior & Wood, 2021).
    """
    chosen = ancestors(key, log_weights, method)

    def take(x: Array) -> Array:
        return x.at[..., chosen].get(mode="promise_in_bounds", indices_are_sorted=True)

    kept = take(log_weights)
    equal = kept - lax.stop_gradient(kept) - jnp.log(jnp.asarray(kept.shape[0], kept.dtype))
    return jax.tree.map(take, cloud), equal


def weighted_moments(x: Array, weights: Array, angle: Angles = None) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n) of x (n, N) under weights (N,) that sum to one; the mean of
    angles in (-pi, pi]."""
    # About one particle: rounded weights do not sum to one, which far from the origin would count.
    # Their sum has a derivative (see `resampled`), which goes with the whole of x.
    total = jnp.sum(weights)
    centre = centre_of(angle, x, weights)
    start = centre * (1 + total - lax.stop_gradient(total))
    if angle is not None:  # an angle has no origin that could be scaled
        start = jnp.where(np.asarray(angle), centre, start)
    apart = wrapped_state(angle, x - centre[:, None])
    shift = matmul(apart, weights[:, None])[:, 0]
    spread = apart - shift[:, None]
    return wrapped_state(angle, start + shift), symmetric.unpack(
        symmetric.pack(matmul(spread * weights[None], spread.T))
    )


def estimator_of_cloud(model: Model) -> Report:
    """The `estimate` of a recursion whose state begins with the fields of `ParticleState`."""

    def estimate(params: Params, state: State) -> Gaussian:
        del params
        return summary(model, state)

    return estimate


def summary(model: Model, state: State) -> Gaussian:
    """Weighted mean (n,) and covariance (n, n) of the particles."""
    weights = jnp.exp(state.log_weights)
    return Gaussian(*weighted_moments(state.particles, weights, model.state_angle))
