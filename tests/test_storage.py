"""What a method stores, against counts from its definition."""

import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.analysis.storage import storage
from ewif_jax.models import constant_velocity, position_sensor

MODEL = constant_velocity(sensors=position_sensor(0.5, 2), q=0.1, dims=2)
N, LAG = 4, 10
PACKED = N * (N + 1) // 2
GAUSSIAN = 1 + N + PACKED
"""time, mean, packed covariance"""
SEEN = 2 * N * 2 + 2 * 2 * 2 + 2
"""H and K, R and S^-1, S^-1 nu"""


@pytest.mark.parametrize(
    ("estimator", "numbers"),
    [
        (ej.extended(MODEL), GAUSSIAN),
        (ej.drop_late(ej.extended(MODEL)), GAUSSIAN),
        (ej.a1(MODEL), 2 * GAUSSIAN),
        (ej.al1(MODEL, LAG), (1 + LAG) * GAUSSIAN),
        (ej.bl1(MODEL, LAG), (1 + LAG) * GAUSSIAN),
        (ej.asd(MODEL, LAG), GAUSSIAN + N * N + (1 + LAG) * (GAUSSIAN + N * N + SEEN)),
        (ej.replay(ej.extended(MODEL), LAG, width=2), 2 + 2 * GAUSSIAN + LAG * (1 + 2)),
    ],
)
def test_numbers_by_definition(estimator, numbers):
    found = storage(estimator, N)
    assert found.numbers == numbers == sum(found.parts.values())


def test_the_history_of_al1_is_what_the_paper_counts():
    """A mean and a covariance for each of ten update times: 140 numbers where covariances are
    symmetric."""
    parts = storage(ej.al1(MODEL, LAG), N).parts
    assert parts["past.mean"] + parts["past.cov"] == 140


def test_an_exponential_filter_keeps_nothing_of_the_past():
    late = storage(ej.ewif(MODEL, tau=1.0), N)
    in_sequence = storage(ej.information(MODEL), N)
    assert late.numbers == in_sequence.numbers


def test_bytes_count_flags_too_and_parameters_are_passed_on():
    found = storage(ej.al1(MODEL, LAG), N)
    assert found.bytes == 8 * found.numbers + 1
    tuned = storage(ej.ewif(MODEL, tau=lambda p: p["tau"]), N, params={"tau": jnp.ones(())})
    assert tuned == storage(ej.ewif(MODEL, tau=1.0), N)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match=r"estimator: expected an Estimator .*, got a Model"):
        storage(MODEL, N)
    with pytest.raises(ValueError, match="n: expected a whole number >= 1"):
        storage(ej.extended(MODEL), np.float64(4.0))
