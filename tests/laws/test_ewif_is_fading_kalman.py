"""The EWIF with a prior is Anderson's filter with Q = 0 and alpha = exp(dt / 2 tau) per step."""

import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from oracles.kalman_loop import fading_filter

import ewif_jax as ej
from laws.cases import STEPS, case, close, model

EWIF = ej.ewif(model(), lambda p: p["tau"])
FADING = ej.fading(model(), inflation=lambda p, t0, t1: jnp.exp((t1 - t0) / p["tau"]))
PER_STEP = ej.fading(model(), lambda p: p["fading"])


@given(st.integers(0, 10_000), st.sampled_from([1, 3]))
def test_irregular_times(seed, n):
    world = case(seed, n, noise_rank=0)
    options = {"prior": world.prior, "t0": 0.0}
    ours = ej.run(EWIF, world.params, world.stream(), **options)
    theirs = ej.run(FADING, world.params, world.stream(), **options)
    for a, b in zip(ours[:3], theirs[:3], strict=True):
        close(a, b)
    close(ours.info.log_likelihood, theirs.info.log_likelihood)
    close(ours.info.innovation_cov, theirs.info.innovation_cov)
    dt = np.diff(world.times, prepend=0.0)
    oracle = fading_filter(
        **world.gaussian(), **world.data(), alphas=np.exp(dt / (2 * world.params["tau"]))
    )
    close(theirs.mean, oracle.means)
    close(theirs.cov, oracle.covs)


def test_equal_intervals_need_one_constant_alpha():
    dt = 0.3
    world = case(2, 3, noise_rank=0)._replace(times=dt * np.arange(1, STEPS + 1))
    world = world._replace(masks=np.ones_like(world.masks))
    params = {**world.params, "fading": np.exp(dt / (2 * world.params["tau"]))}
    options = {"prior": world.prior, "t0": 0.0}
    ours = ej.run(EWIF, params, world.stream(), **options)
    theirs = ej.run(PER_STEP, params, world.stream(), **options)
    close(ours.mean, theirs.mean)
    close(ours.cov, theirs.cov)
