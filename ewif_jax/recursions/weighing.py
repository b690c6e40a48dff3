"""What particles make of a measurement: their densities, the innovation given all, new weights."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.nn import logsumexp

from ewif_jax import checks
from ewif_jax.fast.small import matmul
from ewif_jax.kernels import cholesky, gaussian
from ewif_jax.kernels.resampling import effective_sample_size
from ewif_jax.models import Model
from ewif_jax.models.linearise import noise_at
from ewif_jax.models.sensor_range import check_sensor
from ewif_jax.recursions.particles import weighted_moments
from ewif_jax.types import Info, Measurement, Params, State, Status


class SeenByCloud(NamedTuple):
    """A measurement as the particles see it: log_density (N,) of it given each of them (-inf where
    it is not a number), innovation (m,) and innovation_cov (m, m) given all of them: 0 and the
    identity where none of them makes a number of it."""

    log_density: Array
    innovation: Array
    innovation_cov: Array


class ComparedCloud(NamedTuple):
    """A measurement beside what each particle predicts: predicted (m, N), difference (m, N), 0
    where it is absent or not a number, numbers (N,): where it and its square are numbers, R (m, m)
    with unit variance where it is absent, and its factor."""

    predicted: Array
    difference: Array
    numbers: Array
    R: Array
    factor: cholesky.Factor


def is_late(state: State, measurement: Measurement) -> Array:
    """Whether there is something to look back for, () bool: a branch not taken costs nothing."""
    return (measurement.time < state.time) & jnp.any(measurement.mask)


def look_of_cloud(
    model: Model, params: Params, particles: Array, log_weights: Array, measurement: Measurement
) -> SeenByCloud:
    """The measurement as it is seen by particles (n, N) at its time.

    A component without noise (singular R) cannot weigh particles: no density is a number then.
    """
    found = compared_cloud(model, params, particles, log_weights, measurement)
    density = log_density(found, measurement.mask)
    innovation, spread = averaged_innovation(
        model, params, particles, found.predicted, found.numbers, log_weights, measurement
    )
    cov = found.R + spread
    return SeenByCloud(density, innovation, judged_cov(cov, found.numbers))


def averaged_innovation(
    model: Model,
    params: Params,
    particles: Array,
    predicted: Array,
    numbers: Array,
    log_weights: Array,
    measurement: Measurement,
) -> tuple[Array, Array]:
    """The innovation (m,), and the covariance (m, m) of the predicted values (m, N), given all
    particles (n, N) at the measurement's time."""
    weights = shares(log_weights, numbers)
    origin = stand_in(model, params, numbers, particles, weights, measurement)
    offsets = about(model, origin, predicted, numbers, measurement)
    shift, spread = weighted_moments(offsets, weights)
    return innovation_of(model, origin, shift, numbers, measurement), spread


def compared_cloud(
    model: Model, params: Params, particles: Array, log_weights: Array, measurement: Measurement
) -> ComparedCloud:
    """The measurement beside what particles (n, N) at its time predict."""
    time, value, sensor, mask = measurement
    check_sensor(model, params, particles[:, 0], sensor, time)
    R = _noise_of_cloud(model, params, particles, log_weights, measurement)
    checks.shape("measurement.value", value, (R.shape[0],))

    def predict_value(x: Array) -> Array:
        return jnp.asarray(model.observe(params, x, sensor, time), x.dtype)

    predicted = jax.vmap(predict_value, -1, -1)(particles)
    subtracted = jax.vmap(lambda seen: model.residual(value, seen, sensor), -1, -1)(predicted)
    difference = jnp.where(mask[:, None], subtracted, 0)
    # Particle by particle: one that has run away gets weight zero, the others still see the
    # measurement.
    numbers = jnp.all(jnp.isfinite(jnp.square(difference)), 0)
    R = gaussian.mask_cov(R, mask)
    difference = jnp.where(numbers, difference, 0)
    return ComparedCloud(predicted, difference, numbers, R, cholesky.factor(R))


def _noise_of_cloud(
    model: Model, params: Params, particles: Array, log_weights: Array, measurement: Measurement
) -> Array:
    """R (m, m), of the mean particle where it depends on the state: one for all of them."""
    middle = particles[:, 0]
    if model.jitter is not None:
        finite = jnp.all(jnp.isfinite(particles), 0)
        middle = _mean_of_cloud(model, particles, finite, shares(log_weights, finite))
    return noise_at(model, params, middle, measurement.sensor, measurement.time)


def _mean_of_cloud(model: Model, particles: Array, finite: Array, weights: Array) -> Array:
    """The mean (n,) of those particles that are `finite` (N,), under weights that sum to one."""
    particles, angle = jnp.where(finite, particles, 0), model.state_angle
    if angle is None:
        return matmul(particles, weights[:, None])[:, 0]
    return weighted_moments(particles, weights, angle)[0]


def log_density(found: ComparedCloud, mask: Array) -> Array:
    """log p(z | x) (N,), -inf where it is not a number."""
    f = found.factor
    white = cholesky.forward(f, found.difference)
    size = jnp.sum(mask).astype(white.dtype) * jnp.log(jnp.asarray(2 * jnp.pi, white.dtype))
    density = -0.5 * (jnp.sum(jnp.square(white), 0) + size) - cholesky.half_log_det(f)
    good = found.numbers & jnp.isfinite(density) & f.full_rank
    return jnp.where(good, density, -jnp.inf)


def shares(log_weights: Array, numbers: Array) -> Array:
    """The weights (N,) of those particles that make a number of a measurement, of sum one."""
    weights = jnp.where(numbers, jnp.exp(log_weights), 0)
    total = jnp.sum(weights)
    return weights / jnp.where(total > 0, total, 1)


def stand_in(
    model: Model,
    params: Params,
    numbers: Array,
    particles: Array,
    weights: Array,
    measurement: Measurement,
) -> Array:
    """A value (m,) amid those that the particles predict, from which these are counted: the one
    predicted at the particles' mean, or what was measured where that is not a number.

    Counted from there, predicted angles on both sides of a cut have a mean, and the innovation is
    wrapped once, however far off it is. Nothing depends on the choice but the cut, so no derivative
    goes through it.
    """
    middle = _mean_of_cloud(model, particles, numbers, weights)
    seen = model.observe(params, lax.stop_gradient(middle), measurement.sensor, measurement.time)
    seen = lax.stop_gradient(jnp.asarray(seen, particles.dtype))
    return jnp.where(jnp.isfinite(seen), seen, measurement.value)


def about(
    model: Model, origin: Array, predicted: Array, numbers: Array, measurement: Measurement
) -> Array:
    """The predicted values (m, N) less `origin`, 0 where they are absent or not a number."""
    good = measurement.mask[:, None] & numbers[None]
    safe = jnp.where(good, predicted, origin[:, None])
    offsets = jax.vmap(lambda seen: model.residual(seen, origin, measurement.sensor), -1, -1)(safe)
    return jnp.where(good, offsets, 0)


def innovation_of(
    model: Model, origin: Array, shift: Array, numbers: Array, measurement: Measurement
) -> Array:
    """Measured minus `origin + shift` (m,), wrapped once, 0 where it is absent or no particle makes
    a number of it."""
    difference = model.residual(measurement.value, origin + shift, measurement.sensor)
    return jnp.where(measurement.mask & jnp.any(numbers), difference, 0)


def judged_cov(cov: Array, numbers: Array) -> Array:
    """The innovation's covariance (m, m), the identity where no particle makes a number of it."""
    return jnp.where(jnp.any(numbers), cov, jnp.eye(cov.shape[0], dtype=cov.dtype))


def weigh(
    state: State, seen: SeenByCloud, measurement: Measurement, collapse: float | None = None
) -> tuple[Array, Info]:
    r"""Log weights :math:`\log w_i + \log p(z | x_i)`, normalised (N,), and the `Info`.

    The log likelihood is the logarithm of the mean density under the old weights. The weights stay
    as they were, and the measurement is `REJECTED`, if no particle could have caused it, or if it
    is late and leaves less than 1 / `collapse` of the effective particles.
    """
    joint = state.log_weights + seen.log_density
    explained = jnp.any(joint > -jnp.inf)
    # Minus infinity everywhere has no derivative: what is refused is not computed with.
    joint = jnp.where(explained, joint, state.log_weights)
    # Old weights sum to one, so this is the log of the mean density under them; subtracting it
    # normalises the new ones in the same step, without leaving logarithms.
    evidence = logsumexp(joint)
    log_weights, accepted = joint - evidence, explained
    if collapse is not None:
        # The ratio of effective sizes and not the size itself: a cloud that was thin before is not
        # the late measurement's fault (Orguner & Gustafsson, section IV).
        before, after = (effective_sample_size(w) for w in (state.log_weights, log_weights))
        is_late = measurement.time < state.time
        accepted = explained & ~(is_late & (after * collapse < before))
    info = Info(
        seen.innovation,
        seen.innovation_cov,
        evidence,
        jnp.zeros((), evidence.dtype),
        jnp.where(accepted, jnp.int32(Status.USED), jnp.int32(Status.REJECTED)),
    )
    return jnp.where(accepted, log_weights, state.log_weights), info
