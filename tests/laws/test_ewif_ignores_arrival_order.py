"""Shulami & Sigalov, Theorem 4: the EWIF does not depend on the order of arrival."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import ewif_jax as ej
from laws.cases import STEPS, case, close, model

FILTER = ej.ewif(model(), lambda p: p["tau"])


@pytest.mark.parametrize("with_prior", [True, False])
@given(st.integers(0, 10_000), st.sampled_from([1, 3]), st.permutations(range(STEPS)))
def test_any_order_gives_the_same_estimate(with_prior, seed, n, order):
    world = case(seed, n)
    prior = world.prior if with_prior else None
    options = {"prior": prior, "t0": 0.0, "times": np.full(STEPS, 4.5)}
    sorted_trace = ej.run(FILTER, world.params, world.stream(), **options)
    other = ej.run(FILTER, world.params, world.stream(order), **options)
    close(other.mean[-1], sorted_trace.mean[-1])
    close(other.cov[-1], sorted_trace.cov[-1])


def test_every_late_measurement_is_used():
    world = case(1, 3)
    order = np.arange(STEPS)[::-1]
    info = ej.run(FILTER, world.params, world.stream(order), prior=None, t0=0.0).info
    present = world.masks[order].any(1)
    expected = np.where(present, ej.Status.LATE_USED, ej.Status.MASKED)
    in_sequence = world.times[order] == world.times[order][0]
    expected = np.where(present & in_sequence, ej.Status.USED, expected)
    np.testing.assert_array_equal(info.status, expected)
