"""What particle filters share: drawing, moving, weighing and resampling a cloud of particles.

Particles are the last axis everywhere, so that what a model computes for one state becomes one
operation on contiguous rows.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.scipy.special import logsumexp

from ewif_jax import checks
from ewif_jax.fast.small import matmul
from ewif_jax.kernels import cholesky, gaussian, symmetric
from ewif_jax.kernels.resampling import Resampling, ancestors, effective_sample_size
from ewif_jax.models import Model
from ewif_jax.models.sensor_range import check_sensor
from ewif_jax.recursions.contract import verdict
from ewif_jax.types import Gaussian, Info, Measurement, Status


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


class Seen(NamedTuple):
    """A measurement as the particles see it: log_density (N,) of it given each of them (-inf where
    it is not a number), innovation (m,) and innovation_cov (m, m) given all of them."""

    log_density: Array
    innovation: Array
    innovation_cov: Array


State = TypeVar("State", bound=Any)
"""A NamedTuple that begins with the fields of `ParticleState`."""


def cloud(model: Model, particles: int, resampling: Resampling, ess_threshold: float) -> Cloud:
    """A `Cloud` of checked settings."""
    checks.require(isinstance(model, Model), "model", "a Model", type(model).__name__)
    checks.whole("particles", particles, 2)
    known = resampling in ("systematic", "stratified")
    checks.require(known, "resampling", "'systematic' or 'stratified'", repr(resampling))
    checks.at_least("ess_threshold", ess_threshold, 0.0)
    return Cloud(model, particles, resampling, ess_threshold)


def collapse_factor(collapse: float | None) -> float | None:
    """`collapse` if it is None or a factor >= 1."""
    return None if collapse is None else float(checks.at_least("collapse", collapse, 1.0))


def draw(kind: Cloud, method: str, prior: Gaussian | None, t0: Any, key: Any) -> ParticleState:
    """Equally weighted particles drawn from the prior, whose covariance may be singular."""
    prior = checks.needs_prior(prior, method)
    checks.prior(prior)
    key = checks.needs_key(key, method)
    mean = jnp.asarray(prior.mean)
    N, dtype = kind.particles, mean.dtype
    key, ours = jax.random.split(key)
    particles = mean[:, None] + noise(ours, jnp.asarray(prior.cov, dtype), N)
    log_weights = jnp.full(N, -jnp.log(jnp.asarray(N, dtype)), dtype)
    return ParticleState(jnp.asarray(t0, dtype), particles, log_weights, key)


def noise(key: Array, cov: Array, count: int) -> Array:
    """(n, count) draws from N(0, cov), cov (n, n) singular or not."""
    normals = jax.random.normal(key, (cov.shape[0], count), cov.dtype)
    return matmul(cholesky.factor(cov).lower, normals)


def moved(
    model: Model, params: Any, particles: Array, key: Array, t0: Array, t1: Array
) -> tuple[Array, Array]:
    """Particles (n, N) at t1 >= t0 without their process noise, and with it."""
    still = transported(model, params, particles, t0, t1)
    Q = jnp.asarray(model.process_cov(params, t0, t1), particles.dtype)
    checks.shape("Q", Q, (particles.shape[0],) * 2)
    return still, still + noise(key, Q, particles.shape[1])


def transported(model: Model, params: Any, particles: Array, t0: Array, t1: Array) -> Array:
    """Particles (n, N) moved from t0 to t1, in either direction, without noise."""

    def move(x: Array) -> Array:
        return jnp.asarray(model.transition(params, x, t0, t1), x.dtype)

    return jax.vmap(move, -1, -1)(particles)


def leave(state: State, time: Array, go: Callable[[State], State]) -> State:
    """`go(state)` if `time` is later, `state` itself if it is the same, NaN if it is earlier."""

    def stay(state: State) -> State:
        particles = jnp.where(time == state.time, state.particles, jnp.nan)
        return state._replace(time=time, particles=particles)

    return lax.cond(time > state.time, go, stay, state)


def predictor(kind: Cloud) -> Callable[[Any, State, Array], State]:
    """The `predict` of an estimator whose particles keep nothing of their past."""

    def predict(params: Any, state: State, time: Array) -> State:
        time = jnp.asarray(time, state.time.dtype)
        return leave(state, time, lambda s: step_ahead(kind, params, s, time)[0])

    return predict


def step_ahead(
    kind: Cloud, params: Any, state: Any, time: Array, along: Any = ()
) -> tuple[Any, Any]:
    """The state at a later `time`, and what goes along with the particles (pytrees of arrays with
    the particles as the last axis), both resampled first if too few particles count."""
    key, first, second = jax.random.split(state.key, 3)
    least = kind.ess_threshold * kind.particles
    (particles, along), log_weights = refreshed(
        first, (state.particles, along), state.log_weights, least, kind.resampling
    )
    _, particles = moved(kind.model, params, particles, second, state.time, time)
    state = state._replace(time=time, particles=particles, log_weights=log_weights, key=key)
    return state, along


def refreshed(
    key: Array, cloud: Any, log_weights: Array, least: float, method: Resampling = "systematic"
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


def resampled(key: Array, cloud: Any, log_weights: Array, method: Resampling) -> tuple[Any, Array]:
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


def look(
    model: Model, params: Any, particles: Array, log_weights: Array, measurement: Measurement
) -> Seen:
    """The measurement as it is seen by particles (n, N) at its time.

    A component without noise (singular R) cannot weigh particles: no density is a number then.
    """
    difference, numbers, R, f = compared(model, params, particles, measurement)
    white = cholesky.forward(f, difference)
    size = jnp.sum(measurement.mask).astype(white.dtype) * jnp.log(2 * jnp.pi)
    log_density = -0.5 * (jnp.sum(jnp.square(white), 0) + size) - cholesky.half_log_det(f)
    good = numbers & jnp.isfinite(log_density) & f.full_rank
    weights = jnp.where(numbers, jnp.exp(log_weights), 0)
    innovation, cov = moments(difference, weights)
    return Seen(jnp.where(good, log_density, -jnp.inf), innovation, R + cov)


def compared(
    model: Model, params: Any, particles: Array, measurement: Measurement
) -> tuple[Array, Array, Array, cholesky.Factor]:
    """Measured minus predicted (m, N), whether it and its square are numbers (N,) (else it is 0), R
    and its factor; absent components have difference 0 and unit variance."""
    time, value, sensor, mask = measurement
    check_sensor(model, params, particles[:, 0], sensor, time)
    R = jnp.asarray(model.measurement_cov(params, sensor, time), particles.dtype)
    checks.shape("measurement.value", value, (R.shape[0],))

    def compare(x: Array) -> Array:
        predicted = jnp.asarray(model.observe(params, x, sensor, time), x.dtype)
        return model.residual(value, predicted, sensor)

    difference = jnp.where(mask[:, None], jax.vmap(compare, -1, -1)(particles), 0)
    numbers = jnp.all(jnp.isfinite(jnp.square(difference)), 0)
    R = gaussian.mask_cov(R, mask)
    return jnp.where(numbers, difference, 0), numbers, R, cholesky.factor(R)


def moments(x: Array, weights: Array) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n) of x (n, N) under weights (N,) that sum to one."""
    mean = matmul(x, weights[:, None])[:, 0]
    spread = x - mean[:, None]
    return mean, symmetric.unpack(symmetric.pack(matmul(spread * weights[None], spread.T)))


def estimate(params: Any, state: Any) -> Gaussian:
    """The `estimate` of an estimator whose state begins with the fields of `ParticleState`."""
    del params
    return summary(state)


def summary(state: Any) -> Gaussian:
    """Weighted mean (n,) and covariance (n, n) of the particles."""
    return Gaussian(*moments(state.particles, jnp.exp(state.log_weights)))


def weigh(
    state: Any,
    seen: Seen,
    measurement: Measurement,
    reachable: Array | bool,
    collapse: float | None = None,
) -> tuple[Array, Info]:
    r"""Log weights :math:`\log w_i + \log p(z | x_i)`, normalised (N,), and the `Info`.

    The log likelihood is the logarithm of the mean density under the old weights. The weights stay
    as they were if no particle could have caused the measurement, or if it is late and leaves less
    than 1 / `collapse` of the effective particles (`REJECTED`), and if it is late and not
    `reachable` (`TOO_LATE`).
    """
    late = measurement.time < state.time
    present = jnp.any(measurement.mask)
    joint = state.log_weights + seen.log_density
    kept = jnp.any(joint > -jnp.inf)
    joint = jnp.where(kept, joint, state.log_weights)
    evidence = logsumexp(joint)
    log_weights = joint - evidence
    if collapse is not None:
        before, after = (effective_sample_size(w) for w in (state.log_weights, log_weights))
        kept = kept & ~(late & (after * collapse < before))
    reached = ~late | jnp.asarray(reachable)
    used = present & kept & reached
    status = verdict(late, kept, Status.LATE_USED)
    status = jnp.where(kept, status, jnp.int32(Status.REJECTED))
    status = jnp.where(reached, status, jnp.int32(Status.TOO_LATE))
    info = Info(
        seen.innovation,
        seen.innovation_cov,
        jnp.where(used, evidence, 0),
        state.time - measurement.time,
        jnp.where(present, status, jnp.int32(Status.MASKED)),
    )
    return jnp.where(used, log_weights, state.log_weights), info


def was_used(info: Info) -> Array:
    """Whether the measurement entered the estimate, () bool."""
    return (info.status == Status.USED) | (info.status == Status.LATE_USED)
