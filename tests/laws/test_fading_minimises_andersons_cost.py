"""Anderson (1973), section 5: the filter (5-13)-(5-15) minimises the weighted cost (5-6)."""

import numpy as np
import pytest
from oracles.kalman_loop import fading_filter, weighted_cost_minimiser

import ewif_jax as ej
from laws.cases import STEPS, case, close, model

ALPHA = 1.15
FILTER = ej.fading(model(), lambda p: p["fading"])


def worlds(seed, n, rank):
    world = case(seed, n, rank)
    params = {**world.params, "fading": ALPHA}
    distinct = np.linspace(0.3, 4.0, STEPS)
    return world._replace(params=params, times=distinct, masks=np.ones_like(world.masks))


@pytest.mark.parametrize("rank", [0, 1, 3])
def test_the_last_state_of_the_minimiser_and_its_covariance(rank):
    world = worlds(3, 3, rank)
    trace = ej.run(FILTER, world.params, world.stream(), prior=world.prior, t0=0.0)
    for k in (1, 5, STEPS):
        states, cov = weighted_cost_minimiser(
            **world.gaussian(), **world.data(range(k)), alphas=np.full(k, ALPHA)
        )
        close(trace.mean[k - 1], states[-1], 1e-8)
        close(trace.cov[k - 1], cov, 1e-8)


def test_the_loop_with_masks():
    world = worlds(4, 3, 3)
    world = world._replace(masks=case(4, 3).masks)
    trace = ej.run(FILTER, world.params, world.stream(), prior=world.prior, t0=0.0)
    present = world.masks.any(1)
    alphas = np.where(present, ALPHA, 1.0)
    kept = np.flatnonzero(present)
    loop = fading_filter(**world.gaussian(), **world.data(kept), alphas=alphas[kept])
    close(trace.mean[kept], loop.means)
    close(trace.cov[kept], loop.covs)


def test_alpha_one_is_kalman():
    world = case(6, 3)
    options = {"prior": world.prior, "t0": 0.0}
    params = {**world.params, "fading": 1.0}
    one = ej.run(FILTER, params, world.stream(), **options)
    other = ej.run(ej.kalman(model()), world.params, world.stream(), **options)
    close(one.mean, other.mean)
    close(one.cov, other.cov)
