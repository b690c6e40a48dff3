"""The smoothers inside `pf_fixed_point`: exact where the model is linear."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from late_streams import exact, problem, stream
from oracles.joint_gaussian import posterior

import ewif_jax as ej
from ewif_jax.kernels import symmetric
from ewif_jax.oosm.pf_fixed_point import pf_fixed_point
from ewif_jax.recursions.covariance import CovarianceState
from ewif_jax.recursions.fixed_point import fixed_point, given
from ewif_jax.recursions.particle_smoother import lines, look_back
from ewif_jax.recursions.particles import ParticleState
from ewif_jax.recursions.sigma_points import SigmaPoints

TIMES = np.array([0.5, 1.0, 1.5, 2.0])
NOW = 2.5
KINDS = {"eks": None, "uks": SigmaPoints(), "paper's uks": SigmaPoints(1e-3, 2.0, 0.0)}


def conditioned(problem, data, tau, x):
    """p(x(tau) | x(NOW), all data) by conditioning the joint: x(NOW) is seen without noise."""
    n, sensors = len(x), np.asarray(data.sensor)
    return posterior(
        tau,
        **problem.oracle,
        times=[*np.asarray(data.time), NOW],
        H=[*problem.H[sensors], np.eye(n)],
        R=[*problem.R[sensors], np.zeros((n, n))],
        values=[*np.asarray(data.value), x],
    )


def summary_before(problem, data, tau):
    """The exact filtered estimate at the last time not after tau."""
    means, covs = exact(problem, data)
    k = np.flatnonzero(tau >= TIMES)[-1]
    return CovarianceState(
        jnp.asarray(TIMES[k]), jnp.asarray(means[k]), symmetric.pack(jnp.asarray(covs[k]))
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (3, 2)])
def test_eks_and_uks_are_the_exact_conditional(kind, n, m):
    """In every interval, the last one too, and at a stored time."""
    given_problem = problem(n + 4, n, m)
    rng = np.random.default_rng(n)
    data = stream(given_problem, rng, TIMES)
    smooth = jax.jit(
        lambda start, tau: fixed_point(
            given_problem.model, KINDS[kind], None, start, tau, data, jnp.asarray(NOW)
        )
    )
    tolerance = 1e-8 if kind != "paper's uks" else 1e-6
    for tau in (0.7, 1.0, 1.9, 2.0, 2.3):
        conditional = smooth(summary_before(given_problem, data, tau), jnp.asarray(tau))
        x = rng.normal(size=n)
        mean, cov = conditioned(given_problem, data, tau, x)
        found = given(given_problem.model, conditional, jnp.asarray(x))
        np.testing.assert_allclose(found.mean, mean, atol=tolerance, rtol=tolerance)
        np.testing.assert_allclose(found.cov, cov, atol=tolerance)


def test_the_particle_smoother_approaches_the_exact_density_of_the_late_measurement():
    """For states that may be: the log density within its Monte Carlo error."""
    world = problem(5, 1)
    data = stream(world, np.random.default_rng(1), TIMES)
    track = [world.prior.mean + world.oracle["b"](0.0, t) for t in TIMES]
    seen = [world.H[s] @ x + 0.1 for s, x in zip(np.asarray(data.sensor), track, strict=True)]
    data = data._replace(value=jnp.asarray(np.array(seen)))
    tau, value = 1.2, np.array([0.3])
    start = summary_before(world, data, tau)
    sensor, mask = jnp.asarray(1, jnp.int32), jnp.asarray([True])
    late = ej.Measurement(jnp.asarray(tau), jnp.asarray(value), sensor, mask)
    center, cov = exact(world, data)
    states = (
        center[-1] + world.oracle["b"](2.0, NOW) + np.outer([-1.0, 0.0, 1.0], cov[-1, 0] ** 0.5)
    )
    now = jnp.asarray(NOW)
    cloud = ParticleState(now, jnp.asarray(states.T), jnp.full(3, -jnp.log(3.0)), jnp.zeros(2))

    def one(key):
        last = lines(world.model, None, start, late.time, data, now, 4000, key)
        return look_back(world.model, None, last, now, cloud, late).log_density

    found = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 24)))
    for k, x in enumerate(states):
        mean, cov = conditioned(world, data, tau, x)
        S = world.H[1] @ cov @ world.H[1].T + world.R[1]
        error = value - world.H[1] @ mean
        expected = -0.5 * (error @ np.linalg.solve(S, error) + np.log(2 * np.pi * S[0, 0]))
        spread = found[:, k].std(ddof=1)
        assert spread < 0.02
        assert abs(found[:, k].mean() - expected) < 4 * spread / np.sqrt(24) + spread**2


def test_what_is_stored_does_not_grow_with_lag_times_particles():
    world = problem(3, 3, 2)

    def numbers(particles, lag, smoother):
        method = pf_fixed_point(world.model, particles, lag, smoother)
        make = jax.eval_shape(lambda k: method.init(None, world.prior, 0.0, k), jax.random.key(0))
        return sum(leaf.size for leaf in jax.tree.leaves(make))

    for smoother in ("eks", "uks", "ps"):
        small = numbers(1000, 5, smoother)
        assert numbers(2000, 5, smoother) - small == 1000 * 4
        entry = 1 + 3 + 6 + 1 + 2 + 1 + 2
        assert numbers(1000, 25, smoother) - small == 20 * entry


def compiled_memory(world, particles, lag, smoother):
    """Bytes of the compiled update: its arguments, and what it needs besides."""
    method = pf_fixed_point(world.model, particles, lag, smoother)
    state = jax.eval_shape(lambda k: method.init(None, world.prior, 0.0, k), jax.random.key(0))
    one = jax.tree.map(lambda x: x[0], stream(world, np.random.default_rng(0), TIMES))
    update = jax.jit(lambda state, z: method.update(None, state, z))
    found = update.lower(state, one).compile().memory_analysis()
    return found.argument_size_in_bytes, found.temp_size_in_bytes


def test_the_particle_smoother_never_holds_the_table_of_all_pairs():
    """N M densities of 8 bytes would be 76 MiB."""
    particles = 10_000
    _, temporary = compiled_memory(problem(3, 2), particles, 5, "ps")
    table = particles * (particles // 10) * 8
    assert temporary < table / 10


@pytest.mark.parametrize("smoother", ["eks", "uks"])
def test_memory_does_not_grow_with_lag_times_particles(smoother):
    """Twenty more slots cost less than one more number for each particle."""
    particles = 10_000
    short, long = (sum(compiled_memory(problem(3, 2), particles, lag, smoother)) for lag in (5, 25))
    assert long - short < 8 * particles
