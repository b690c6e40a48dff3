"""The studies of late measurements run from end to end."""

import jax
import numpy as np
import pytest
import xarray as xr

from ewif_jax.analysis.gain_history import gain_history
from ewif_jax.estimators.ewif import ewif
from ewif_jax.estimators.extended import extended
from ewif_jax.monte_carlo import monte_carlo, simulate_batch
from ewif_jax.oosm.replay import replay
from ewif_jax.oosm.selective import selective
from ewif_jax.scenarios import (
    arbitrary_target,
    arbitrary_target_model,
    arrowhead,
    arrowhead_ekf,
    arrowhead_ekf_model,
)
from ewif_jax.study.cli import run
from ewif_jax.study.papers.arbitrary_target import study as arbitrary
from ewif_jax.study.papers.gains import study as gains
from ewif_jax.study.papers.tuning_under_delay import study as tuning
from ewif_jax.study.shared.experiment import Experiment, Options
from ewif_jax.study.shared.late import history_needed, mean_of, paired, rmse_of, sweep
from ewif_jax.types import Measurement

FILES = {
    "gains": {"fig1.png", "fig2.png", "fig3.png", "late_loss.csv"},
    "random-walk": {"fig4.png", "fig5.png", "fig6.png", "cutoff.csv", "delays.csv"},
    "arrowhead": {"path.png", "cutoff.png", "lag.png", "cutoffs.csv"},
    "arrowhead-ekf": {"fig10.png"},
    "arbitrary-target": {"fig2.png", "animation.gif", "smoothers.csv"},
    "tuning-under-delay": {"landscape.png", "descent.png"},
    "latency": {"landscape.png", "estimates.png", "grid.csv", "position.csv"},
    "manoeuvres": {"errors.png", "modes.png"},
}


LONG = ("random-walk", "tuning-under-delay", "latency", "manoeuvres")
"""Whose parts are tested one by one too; whole with --all."""
EVERY = [pytest.param(x, marks=pytest.mark.slow if x in LONG else ()) for x in FILES]


@pytest.mark.parametrize("name", EVERY)
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
    assert rmse_of(squared).value == pytest.approx(np.sqrt(29 / 3))
    assert paired(squared, other) == pytest.approx((1.0, 0.0))
    assert mean_of(np.asarray([1.0, 3.0])) == pytest.approx((2.0, 1.0))


def test_regular_gains_are_the_closed_form():
    """With equal intervals the gains that are followed are those of eq. (5)."""
    for case in gains.gain_cases():
        n, steps, lag = case.H.shape[1], 300, 8
        F, Q = (np.broadcast_to(x(case.interval), (steps, n, n)) for x in (case.F, case.Q))
        found = gain_history(F, case.H, Q, np.eye(1), np.eye(n), lag)
        exact = gains.closed_form(case, case.interval * np.arange(lag + 1))
        np.testing.assert_allclose(found.gain[-1, :, :, 0], exact, rtol=1e-6, atol=1e-10)


def test_old_gains_at_poisson_times():
    """Fig. 2: fresh 0.563 for 0.618 in theory, and 8 back half a unit of logarithm more; Fig. 1,
    where little happens in an interval: within 0.03 in the logarithm."""
    low, typical, _ = gains.gain_cases()
    keys = jax.random.split(jax.random.key(0), 400)
    ages, found = gains.actual(typical, keys)
    theory = gains.closed_form(typical, ages)
    fresh = mean_of(found[:, 0, 0])
    assert theory[0, 0, 0] == pytest.approx((np.sqrt(5) - 1) / 2)
    assert abs(fresh.value - 0.563) < 4 * fresh.error < 0.05
    slower = mean_of(np.log(found[:, 8, 0] / theory[:, 8, 0]))
    assert abs(slower.value - 0.47) < 4 * slower.error < 0.4
    assert slower.value > 4 * slower.error
    ages, found = gains.actual(low, keys)
    ratio = np.log(found[..., 0] / gains.closed_form(low, ages)[..., 0])
    for back in gains.AGES:
        mean = mean_of(ratio[:, back])
        assert abs(mean.value) < 0.03 + 3 * mean.error


def test_order_of_the_arbitrary_targets_regimes():
    """Late measurements help, a lag of 1 s helps, and both help most: run by run."""
    estimator = ewif(arbitrary_target_model(), tau=arbitrary.TAU)
    plain, lagged, late, both = (
        monte_carlo(
            estimator, None, arbitrary_target(*regime), runs=40, key=jax.random.key(0)
        ).per_run["squared_error"]
        for regime in arbitrary.REGIMES.values()
    )
    for better, worse in ((late, plain), (lagged, plain), (both, late), (both, lagged)):
        difference = paired(better, worse)
        assert difference.value < -4 * difference.error


@pytest.mark.slow
def test_what_the_extended_filter_gains_up_to_5_seconds():
    """Arrowhead: RMSE 15.79 +- 0.04 with everything; most of what dropping costs is back at 5 s."""
    scenario = arrowhead_ekf(steps=2000)
    batch = simulate_batch(scenario, jax.random.split(jax.random.key(2), 16))
    slots = history_needed(batch.measurements)
    method = selective(
        replay(extended(arrowhead_ekf_model()), slots, width=4), lambda p: p["limit"]
    )
    limits = {"limit": np.asarray([0.5, 5.5, np.inf])}
    dropped, five, everything = sweep(method, limits, batch, prior=scenario.prior, t0=0.0)[
        "squared_error"
    ]
    found = rmse_of(everything)
    assert abs(found.value - 15.79) < 4 * np.hypot(found.error, 0.04)
    assert found.error < 0.3
    for better, worse in ((five, dropped), (everything, five)):
        difference = paired(better, worse)
        assert difference.value < -4 * difference.error
    least, most = found.value, rmse_of(dropped).value
    assert 0.05 < (rmse_of(five).value - least) / (most - least) < 0.3


@pytest.mark.parametrize(
    "number", [pytest.param(0, marks=pytest.mark.slow), 1], ids=["Al1", "EWIF"]
)
def test_what_is_learned_through_late_measurements_is_better_on_other_runs(number, tmp_path):
    """A short descent from the published setting; judged on runs that it has not seen."""
    one = tuning.delay_methods()[number]._replace(grid=np.zeros(0))
    scenario = arrowhead(r=tuning.VARIANCE, steps=600)
    seen, batch = (simulate_batch(scenario, jax.random.split(jax.random.key(k), 8)) for k in (3, 4))
    lag = max(history_needed(x.measurements) for x in (seen, batch))
    experiment = Experiment("tuning", Options(out=tmp_path, quick=True))
    prior = scenario.prior if one.prior else None
    found = tuning._found_optimum(experiment, one, lag, seen, batch, prior)
    published, learned = found["squared"]
    difference = paired(learned, published)
    assert difference.value < -4 * difference.error
    assert found["loss"][-1] < found["loss"][0]
