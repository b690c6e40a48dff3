"""The sine study from the command line: what the paper prints, and what the gradient finds."""

import json

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from ewif_jax.study.cli import run
from ewif_jax.study.papers.sine import study as sine


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    out = tmp_path_factory.mktemp("results")
    assert run(["study", "sine", "--quick", "--runs", "400", "--out", str(out)]) == 0
    return out / "sine"


@pytest.fixture(scope="module")
def table(results):
    return pd.read_csv(results / "sine.csv").set_index(["filter", "setting"])


def test_exact_error_of_the_published_settings(table):
    assert table.loc[("EWIF", "published"), "exact expected RMSE"] == 0.3001
    assert table.loc[("KF", "published"), "exact expected RMSE"] == 0.3196


def test_simulation_agrees_with_the_exact_error(table):
    off = table["Monte Carlo RMSE"] - table["exact expected RMSE"]
    assert np.all(np.abs(off) < 4 * table["Monte Carlo RMSE_se"] + 1e-4)


def test_the_papers_single_runs_are_ordinary(results):
    """0.31 and 0.33 are one realisation each: they lie well inside the spread of single runs."""
    with xr.open_dataset(results / "sine.nc", engine="h5netcdf") as arrays:
        for name, printed in (("EWIF", 0.31), ("KF", 0.33)):
            single = arrays[f"{name}_rmse_of_run"].sel(setting="published").values
            assert 0.1 < np.mean(single < printed) < 0.9


@pytest.mark.parametrize(
    ("name", "parameter", "best"), [("EWIF", "tau", 0.4668), ("KF", "sigma_w", 0.1541)]
)
def test_gradient_finds_the_optimum_from_both_sides(results, name, parameter, best):
    with xr.open_dataset(results / "sine.nc", engine="h5netcdf") as arrays:
        path = arrays[f"{name}_descent_{parameter}"].values
        start = next(one.starts for one in sine.filters() if one.name == name)
        assert path[0] == pytest.approx(start)
        assert path[-1] == pytest.approx(best, rel=0.01)
        assert arrays[f"{name}_descent_rmse"].values[-1] == pytest.approx(0.2996, abs=1e-4)


def test_equivalent_tau(results):
    tau = pd.read_csv(results / "equivalent.csv")["equivalent_tau_s"]
    assert tau.to_numpy() == pytest.approx([0.7077, 0.722], abs=5e-4)


def test_results_describe_themselves(results):
    about = json.loads((results / "about.json").read_text())
    for key in ("command", "seed", "version", "source", "dtype", "devices", "date", "compile_s",
                "run_s"):  # fmt: skip
        assert about[key] is not None
    assert about["dtype"] == "float64"
    assert about["command"].startswith("ewif-jax study sine --quick")
    assert not (results.parent / "sine.partial").exists()
    for name in ("tracks", "rmse", "tuning"):
        picture = (results / f"{name}.png").read_bytes()
        assert picture.startswith(b"\x89PNG")
        assert len(picture) > 20_000
