"""The study of the turn runs from end to end."""

import jax
import numpy as np
import pandas as pd
import xarray as xr

import ewif_jax as ej
from ewif_jax.scenarios import turn as turn_scenario
from ewif_jax.scenarios import turn_model
from ewif_jax.study.cli import run
from ewif_jax.study.papers.turn import runs as runs_of
from ewif_jax.study.papers.turn import study as turn

FILES = {
    "about.json", "claims.csv", "fig3_position.png", "fig4_velocity.png", "pareto.png",
    "storage.csv", "tracks.png", "turn.csv", "turn.nc",
}  # fmt: skip
METHODS = tuple(runs_of.turn_methods(10))


def light(particles=10):
    """Every name of the study, with filters that compile fast."""
    del particles
    model = turn_model()
    plain = runs_of.TurnMethod(ej.extended(model))
    known = {
        runs_of.EKS: runs_of.TurnMethod(ej.al1(model, runs_of.LAG)),
        runs_of.ORD: runs_of.TurnMethod(ej.extended(model), in_order=True),
        runs_of.PS: runs_of.TurnMethod(
            ej.replay(ej.extended(model), runs_of.BUFFER, width=2), share=0.5
        ),
    }
    return {name: known.get(name, plain) for name in METHODS}


def test_study_runs_end_to_end(tmp_path, monkeypatch):
    monkeypatch.setattr(runs_of, "turn_methods", light)
    monkeypatch.setattr(turn, "BLOCK", 8)
    assert run(["study", "turn", "--quick", "--runs", "16", "--out", str(tmp_path)]) == 0
    folder = tmp_path / "turn"
    assert {path.name for path in folder.iterdir()} == FILES
    with xr.open_dataset(folder / "turn.nc", engine="h5netcdf") as stored:
        assert stored["position_rmse"].dims == ("filter", "time")
        assert np.isfinite(stored["position_rmse"]).all()
        assert stored["position_error_PFstd"].shape == (16, 31)
        assert stored["position_error_PFoosmPS"].shape == (8, 31)
        assert float(stored["too_late"].sel(filter="PFoosmPS")) == 0
        assert 15 < float(stored["late_used"].sel(filter="PFoosmPS")) < 25
    table = pd.read_csv(folder / "turn.csv").set_index("filter")
    assert table.loc["PFord", "position RMS [m]"] < table.loc["PFstd", "position RMS [m]"]
    claims = pd.read_csv(folder / "claims.csv")
    assert set(claims["holds"]) <= {"yes", "no", "not beyond noise"}
    assert (claims["reason"].isna() == (claims["holds"] == "yes")).all()
    assert (table["s/run_se"] > 0).all()


def test_the_sigma_points_are_the_printed_ones_where_they_can_be():
    assert "alpha = 1e-3, beta" in runs_of.sigma_points_note()
    with jax.enable_x64(False):
        assert "cubature" in runs_of.sigma_points_note()
        prior = turn_scenario().prior
        state = runs_of.turn_methods(10)[runs_of.UKF].estimator.init(None, prior, 0.0)
        assert state.mean.dtype == "float32"
