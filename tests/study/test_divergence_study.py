"""Data saturation from the command line: without a remedy the filter diverges, with one not."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from ewif_jax.scenarios.divergence import PUSHES, REMEDIES, divergence_curve
from ewif_jax.study.cli import run
from ewif_jax.study.papers.divergence import study


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    out = tmp_path_factory.mktemp("results")
    assert run(["study", "divergence", "--quick", "--runs", "300", "--out", str(out)]) == 0
    return out / "divergence"


@pytest.fixture(scope="module")
def table(results):
    rows = pd.read_csv(results / "divergence.csv")
    names = {text: name for name, text in study.TEXT.items()}
    rows["remedy"] = rows["remedy"].fillna("none").map(names)
    return rows.set_index(["push", "remedy"])


def test_simulations_follow_the_exact_curves(results):
    """At every time within 5 standard errors and the 0.1 s of the sampling."""
    with xr.open_dataset(results / "divergence.nc", engine="h5netcdf") as found:
        exact = found["mse_exact"]
        off = np.abs(found["mse"] - exact)
        assert np.all(off < 5 * found["mse_se"] + 0.15 * exact)


def test_the_closed_forms_of_the_paper_corrected(table):
    assert table.loc[("white", "none"), "its value"] == pytest.approx(2.1474, abs=5e-5)
    assert table.loc[("constant", "none"), "its value"] == pytest.approx(9.9252, abs=5e-5)
    np.testing.assert_allclose(table["its value"], table["exact"], rtol=2e-3)


def test_only_the_filter_without_a_remedy_diverges(table):
    for push in PUSHES:
        rows = table.loc[push]
        assert rows.loc["none", "exact"] > 1.7 * rows.loc["none", "halfway"]
        kept = rows.drop("none")
        np.testing.assert_allclose(kept["exact"], kept["halfway"], rtol=0.02)
        worst = kept["simulated"] + 3 * kept["simulated_se"]
        assert np.all(worst < rows.loc["none", "simulated"] - 3 * rows.loc["none", "simulated_se"])


def test_the_printed_formula_for_a_constant_push_is_wrong(table):
    row = table.loc[("constant", "none")]
    printed = 1 / 21 + 0.3 * 21 / 2
    assert row["simulated"] - printed > 20 * row["simulated_se"]


def test_the_chosen_settings_are_the_best_settled_ones():
    """Under the white push, against a fine search over settled errors."""
    late = np.array([400.0])
    for remedy in REMEDIES[1:]:
        best = study.chosen_setting(remedy, 0.001)
        mse = [
            float(divergence_curve(remedy, "white", late, eps=0.3, setting=scale * best)[0])
            for scale in (0.9, 1.0, 1.1)
        ]
        assert mse[1] < min(mse[0], mse[2])


def test_figures_are_there(results):
    for name in ("divergence", "settings"):
        assert (results / f"{name}.png").stat().st_size > 20_000
