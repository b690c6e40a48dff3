"""The limited-memory filter is unweighted least squares of what its window holds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.limited_memory import limited_memory
from oracles.wls import batch_wls, window_weight

import ewif_jax as ej
from laws.cases import STEPS, case, close, model

WINDOW = 2.205
FILTER = ej.limited_memory(model(), lambda p: p["window"], STEPS)


def world_with_window(seed, n):
    world = case(seed, n)
    return world._replace(params={**world.params, "window": WINDOW})


@given(st.integers(0, 10_000), st.permutations(range(3, STEPS)))
def test_late_arrivals_inputs_and_masks(seed, order):
    world = world_with_window(seed, 2)
    arrivals = [0, 1, 2, *order]
    trace = ej.run(FILTER, world.params, world.stream(arrivals), prior=None, t0=0.0)
    for k in range(2, STEPS):
        if not np.isfinite(trace.mean[k]).all():
            continue
        now, known = float(trace.time[k]), np.array(arrivals[: k + 1])
        past = known[world.times[known] <= now]
        mean, cov = limited_memory(now, WINDOW, **world.back(), **world.data(past))
        close(trace.mean[k], mean, 1e-7)
        close(trace.cov[k], cov, 1e-7)
    assert np.isfinite(trace.mean[-1]).all()


def test_a_prior_counts_while_it_is_inside_the_window():
    world = world_with_window(5, 3)
    trace = ej.run(FILTER, world.params, world.stream(), prior=world.prior, t0=0.0)
    prior = (world.prior.mean, world.prior.cov, 0.0)
    for k in (2, STEPS - 1):
        mean, cov = batch_wls(
            world.times[k],
            **world.back(),
            **world.data(range(k + 1)),
            weight=window_weight(WINDOW),
            prior=prior,
        )
        close(trace.mean[k], mean, 1e-8)
        close(trace.cov[k], cov, 1e-8)


def test_what_is_older_than_the_window_is_too_late():
    world = world_with_window(5, 3)
    order = np.array([*range(1, STEPS), 0])
    world = world._replace(times=np.linspace(0.3, 4.0, STEPS))
    info = ej.run(FILTER, world.params, world.stream(order), prior=None, t0=0.0).info
    assert info.status[-1] == ej.Status.TOO_LATE


@pytest.mark.parametrize("capacity", [3, 5])
def test_a_full_buffer_drops_the_oldest_by_validity_time(capacity):
    world = case(7, 2)._replace(masks=np.ones((STEPS, 2), bool))
    small = ej.limited_memory(model(), 100.0, capacity)
    order = np.array([0, 1, 2, 5, 3, 4, 7, 6, 8, 9])
    trace = ej.run(small, world.params, world.stream(order), prior=None, t0=0.0)
    newest = world.times.max()
    kept = np.sort(order)[-capacity:]
    mean, cov = limited_memory(newest, 100.0, **world.back(), **world.data(kept))
    close(trace.mean[-1], mean, 1e-8)
    close(trace.cov[-1], cov, 1e-8)
