"""Every published method for late measurements is in the table of storage."""

import importlib
import pkgutil

import numpy as np
import pytest

from ewif_jax import oosm
from ewif_jax.analysis.storage import storage
from ewif_jax.study.shared.late_methods import late_methods, storage_rows

SETTING = {"lag": 5, "members": 250, "particles": 10_000}


@pytest.fixture(scope="module")
def rows():
    return {row["method"]: row for row in storage_rows(5, 2, **SETTING)}


def test_nothing_is_left_out(rows):
    for module in pkgutil.iter_modules(oosm.__path__):
        if not module.ispkg:
            assert any(name.startswith(module.name) for name in rows), module.name
            assert importlib.import_module(f"ewif_jax.oosm.{module.name}").__doc__
    assert "ewif" in rows


def test_particles_of_the_past_against_means_and_covariances(rows):
    """Orguner & Gustafsson count 250,000 numbers for EXT and, with symmetric covariances, 130 for
    the smoothers ((32) for n = 5, m = 2, lag 5): that, the times, and a spare measurement."""
    kept = storage(late_methods(5, 2, **SETTING)["pf_extended"][0], 5).parts
    assert kept["past"] == 250_000
    summary = storage(late_methods(5, 2, **SETTING)["pf_fixed_point, eks"][0], 5).parts
    assert summary["past.mean"] + summary["past.cov"] == 6 * (5 + 15)
    assert summary["measured.value"] == 6 * 2
    assert rows["pf_extended"]["for late data"] > 1000 * rows["pf_fixed_point, ps"]["for late data"]


def test_what_needs_no_memory_has_none(rows):
    for name in ("drop_late", "ewif", "pf_retrodict"):
        assert rows[name]["for late data"] == 0
    assert rows["enkf2, shared"]["for late data"] == pytest.approx(
        2 * rows["enkf2, fresh"]["for late data"], rel=0.01
    )
    assert np.all([row["numbers"] >= row["for late data"] >= 0 for row in rows.values()])
