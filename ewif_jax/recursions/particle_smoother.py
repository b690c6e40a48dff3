"""A small particle smoother: the state at a late time given any of many states now."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from ewif_jax.fast.small import matmul
from ewif_jax.kernels import cholesky, symmetric
from ewif_jax.models import Model
from ewif_jax.models.angles import wrapped_state
from ewif_jax.recursions import particles as form
from ewif_jax.recursions import weighing
from ewif_jax.recursions.covariance import CovarianceState
from ewif_jax.recursions.particles import weighted_moments
from ewif_jax.recursions.weighing import SeenByCloud
from ewif_jax.types import Measurement, Params, State

BLOCK = 256
"""How many particles are compared with all smoother particles at a time."""


class Lines(NamedTuple):
    """M particles that keep their past: time (), particles (n, M) at it, fixed (n, M): where each
    came from at the fixed point, log_weights (M,), key."""

    time: Array
    particles: Array
    fixed: Array
    log_weights: Array
    key: Array


def lines(
    model: Model,
    params: Params,
    start: CovarianceState,
    tau: Array,
    measurements: Measurement,
    now: Array,
    count: int,
    key: Array,
) -> Lines:
    """Algorithm 1 of Orguner & Gustafsson up to the last measurement inside (tau, now).

    `count` particles are drawn from `start`, moved to tau and kept there, moved on through the
    measurements ((L,) in order of time), weighed by each and resampled (systematic) with what they
    keep where fewer than half of them count.

    Deviations: the printed recursion does not say that particles are weighed by y(m).
    """
    key, first, second = jax.random.split(key, 3)
    drawn = start.mean[:, None] + form.gaussian_draws(first, symmetric.unpack(start.cov), count)
    _, there = form.moved_particles(model, params, drawn, second, start.time, tau)
    log_weights = jnp.full(count, -jnp.log(jnp.asarray(count, there.dtype)), there.dtype)

    def follow(state: Lines, measurement: Measurement) -> Lines:
        key, first, second = jax.random.split(state.key, 3)
        _, ahead = form.moved_particles(
            model, params, state.particles, first, state.time, measurement.time
        )
        seen = weighing.look_of_cloud(model, params, ahead, state.log_weights, measurement)
        moved = Lines(measurement.time, ahead, state.fixed, state.log_weights, key)
        log_weights, _ = weighing.weigh(moved, seen, measurement)
        (ahead, fixed), log_weights = form.refreshed(
            second, (ahead, state.fixed), log_weights, count / 2
        )
        return Lines(measurement.time, ahead, fixed, log_weights, key)

    def passed(state: Lines, measurement: Measurement) -> tuple[Lines, None]:
        inside = (measurement.time > tau) & (measurement.time < now)
        inside = inside & jnp.any(measurement.mask)
        # What is not inside is passed over by `cond`; its time is replaced because `vmap` makes a
        # `where` of the `cond`, and then both branches run, gradients included.
        safe = measurement._replace(time=jnp.where(inside, measurement.time, state.time))
        return lax.cond(inside, follow, lambda state, _: state, state, safe), None

    state = Lines(tau, there, there, log_weights, key)
    return lax.scan(passed, state, measurements)[0]


def look_back(
    model: Model, params: Params, last: Lines, now: Array, state: State, measurement: Measurement
) -> SeenByCloud:
    r"""A late measurement as it is seen by particles now (n, N), through the lines.

    .. math::
        p(y_\tau | x_k^i) = \sum_j \mu^{ij} p(y_\tau | \xi_\tau^j), \quad
        \mu^{ij} \propto \mu^j N(x_k^i; f_{k,r}(\xi_r^j), Q_{k,r}) \quad (30), (47)-(49)

    with r the last time before k of the lines: N M densities, in blocks of `BLOCK` rows that are
    normalised by their largest term (most underflow otherwise). Where the best lines of a particle
    leave nothing of p(y | xi), the particle gets weight zero. A singular Q has no density: no
    particle then has a weight, and the measurement is `REJECTED`.
    """
    ahead = form.transported(model, params, last.particles, last.time, now)
    f = cholesky.factor(jnp.asarray(model.process_cov(params, last.time, now), ahead.dtype))
    found = weighing.compared_cloud(model, params, last.fixed, last.log_weights, measurement)
    line_density = weighing.log_density(found, measurement.mask)
    line_weights = weighing.shares(last.log_weights, found.numbers)
    origin = weighing.stand_in(model, params, found.numbers, last.fixed, line_weights, measurement)
    offsets = weighing.about(model, origin, found.predicted, found.numbers, measurement)
    angle = model.state_angle
    center = jnp.mean(ahead, 1, keepdims=True)
    if angle is not None:
        center = weighted_moments(ahead, line_weights, angle)[0][:, None]
    # White coordinates: with Q = L L' the density of a step is that of a squared distance. About
    # the centre, because squares of large coordinates would leave no digits of their difference.
    targets, points = (
        cholesky.forward(f, wrapped_state(angle, x - center)) for x in (ahead, state.particles)
    )
    best = jnp.max(line_density)
    best = jnp.where(best > -jnp.inf, best, 0)
    density = jnp.exp(line_density - best)
    m = offsets.shape[0]
    squares = (offsets[:, None] * offsets[None]).reshape(m * m, -1)
    # All sums over the lines have the same weights, so they are columns of one product: the N M
    # weights are formed block by block and never stored.
    columns = jnp.stack([jnp.ones_like(density), density, *offsets, *squares], 1)

    def means(x: Array) -> Array:
        """Means of the columns over the lines, weighted by how well they lead to x (n,)."""
        log_weights = last.log_weights - 0.5 * jnp.sum(jnp.square(targets - x[:, None]), 0)
        weighted = jnp.exp(log_weights - jnp.max(log_weights)) @ columns
        return weighted / weighted[0]

    sums = lax.map(means, points.T, batch_size=BLOCK).T
    possible = f.full_rank & (sums[1] > 0)
    log_density = jnp.where(possible, jnp.log(jnp.where(possible, sums[1], 1)) + best, -jnp.inf)
    w = jnp.exp(state.log_weights)[:, None]
    shift, square = (matmul(x, w)[:, 0] for x in (sums[2 : 2 + m], sums[2 + m :]))
    innovation = weighing.innovation_of(model, origin, shift, found.numbers, measurement)
    cov = found.R + square.reshape(m, m) - shift[:, None] * shift[None]
    return SeenByCloud(log_density, innovation, weighing.judged_cov(cov, found.numbers))
