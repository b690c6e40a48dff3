"""Orguner & Gustafsson, section IV, at reduced size: each claim as we measure it."""

import jax
import numpy as np
import pytest

from ewif_jax.analysis.storage import storage
from ewif_jax.study import turn as study
from ewif_jax.study import turn_runs as runs_of
from ewif_jax.study.claims import ratio
from ewif_jax.study.late import rmse

RUNS = 24
REFERENCE = {
    runs_of.STD: ((98.0, 2.5), (26.8, 0.4)),
    runs_of.ORD: ((58.0, 1.2), (24.3, 0.4)),
    runs_of.EXT: ((72.0, 1.5), (25.6, 0.4)),
    runs_of.EKS: ((73.5, 1.5), (26.5, 0.5)),
}
"""independently computed: RMS of position and velocity with their standard errors"""


@pytest.fixture(scope="module")
def found():
    batches = runs_of.simulated(jax.random.key(7), RUNS)
    every, own = runs_of.methods(10_000), jax.random.split(jax.random.key(8), RUNS)
    return {
        name: runs_of.followed(every[name], batches[every[name].in_order], own)
        for name in REFERENCE
    }


@pytest.mark.parametrize("name", REFERENCE)
def test_errors_are_those_of_an_independent_computation(found, name):
    for kind, (value, error) in zip(("position", "velocity"), REFERENCE[name], strict=True):
        ours = rmse(study.settled(found[name], kind))
        assert abs(ours.value - value) < 4 * np.hypot(ours.error, error)


def test_late_measurements_help_and_in_time_they_would_help_more(found):
    off = {name: study.settled(one) for name, one in found.items()}
    for better, worse in (
        (runs_of.EKS, runs_of.STD),
        (runs_of.EXT, runs_of.STD),
        (runs_of.ORD, runs_of.EKS),
    ):
        gain = ratio(off[better], off[worse])
        assert gain.value + 3 * gain.error < 1


def test_what_stores_no_particles_is_as_good_as_what_does(found):
    """Over 320 runs the ratio is 1.008, 0.995 to 1.024."""
    same = ratio(study.settled(found[runs_of.EKS]), study.settled(found[runs_of.EXT]))
    assert abs(same.value - 1) < 3 * same.error + 0.01
    every = runs_of.methods(10_000)
    held = {name: storage(every[name].estimator, 5).numbers for name in REFERENCE}
    assert held[runs_of.EKS] - held[runs_of.STD] < (held[runs_of.EXT] - held[runs_of.STD]) / 1000


def test_every_late_measurement_is_used_but_for_a_few_that_are_rejected(found):
    for name in (runs_of.EXT, runs_of.EKS):
        assert found[name]["too_late"].sum() == 0
        assert 19 < found[name]["late_used"].mean() < 23
        assert found[name]["rejected"].mean() < 0.5
    assert found[runs_of.STD]["late_used"].sum() == 0
    assert found[runs_of.STD]["too_late"].sum() > 0
