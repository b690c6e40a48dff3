"""The studies of late measurements run from end to end."""

import numpy as np
import pytest
import xarray as xr

from ewif_jax.study import gains
from ewif_jax.study.cli import run
from ewif_jax.study.late import history_needed, mean_of, paired, rmse
from ewif_jax.types import Measurement

FILES = {
    "gains": {"fig1.png", "fig2.png", "fig3.png", "late_loss.csv"},
    "random-walk": {"fig4.png", "fig5.png", "fig6.png", "cutoff.csv", "delays.csv"},
    "arrowhead": {"path.png", "cutoff.png", "lag.png", "cutoffs.csv"},
    "arrowhead-ekf": {"fig10.png"},
    "arbitrary-target": {"fig2.png", "animation.gif", "smoothers.csv"},
    "tuning-under-delay": {"landscape.png", "descent.png"},
}


@pytest.mark.parametrize("name", FILES)
def test_study_runs_end_to_end(name, tmp_path, capsys):
    assert run(["study", name, "--quick", "--runs", "2", "--out", str(tmp_path)]) == 0
    assert "±" in capsys.readouterr().out
    folder, stem = tmp_path / name, name.replace("-", "_")
    found = {path.name for path in folder.iterdir()}
    assert found == FILES[name] | {"about.json", f"{stem}.csv", f"{stem}.nc"}
    with xr.open_dataset(folder / f"{stem}.nc", engine="h5netcdf") as stored:
        assert stored.attrs["study"] == name
        errors = [x for x in stored.data_vars if "rmse" in str(x)]
        assert name == "gains" or errors
        assert all(np.isfinite(stored[x]).all() for x in errors)


def test_history_needed_counts_the_update_times_behind():
    time = np.asarray([[1.0, 2.0, 3.0, 1.5, 4.0, 3.0], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]])
    stream = Measurement(time, time[..., None], np.zeros(6, int), np.ones((2, 6, 1), bool))
    assert history_needed(stream) == 2
    assert history_needed(Measurement(*(x[1:] if np.ndim(x) > 1 else x for x in stream))) == 1


def test_errors_of_runs():
    squared, other = np.asarray([4.0, 9.0, 16.0]), np.asarray([1.0, 4.0, 9.0])
    assert rmse(squared).value == pytest.approx(np.sqrt(29 / 3))
    assert paired(squared, other) == pytest.approx((1.0, 0.0))
    assert mean_of(np.asarray([1.0, 3.0])) == pytest.approx((2.0, 1.0))


def test_regular_gains_are_the_closed_form():
    """With equal intervals what is followed is eq. (5) exactly."""
    for case in gains.cases():
        ages = case.interval * np.arange(4)
        loop = gains.closed_form(case, ages)
        assert loop.shape == (4, len(case.components))
        assert np.all(np.abs(loop[1:, 0]) < np.abs(loop[:-1, 0]))
