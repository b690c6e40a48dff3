"""Random walks of Yoder et al., section 4.1 and Figs. 4-6: up to which delay is a late measurement
worth its while?"""

from typing import Any, NamedTuple

import jax
import numpy as np
import xarray as xr

from ewif_jax.analysis.merit import maneuvering_index, random_walk_cutoff, random_walk_gain
from ewif_jax.estimators.ewif import ewif
from ewif_jax.monte_carlo import Simulation, simulate_batch
from ewif_jax.oosm.al1 import al1
from ewif_jax.oosm.selective import selective
from ewif_jax.scenarios.random_walk import random_walk, random_walk_model
from ewif_jax.study import random_walk_figures
from ewif_jax.study.experiment import Experiment
from ewif_jax.study.late import exact_late, history_needed, joined, paired, rmse, rmses, sweep
from ewif_jax.tuning import rmse_loss, tune
from ewif_jax.types import Estimator

VARIANCE, INTERVAL, RATIO = 2500.0, 0.2, 0.6
MULTIPLES = np.asarray(
    [0, 0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1, 1.5, 2, 3, 5, 10, 30, 100, np.inf]
)
AT_CUTOFF = 7
"""where `MULTIPLES` holds 1"""
DELAYS = np.asarray([0.05, 0.2, 1.0, 5.0, 20.0, 100.0])


class Case(NamedTuple):
    """One panel of Fig. 4: process noise sigma_Q in m/sqrt(s) and mean delay in seconds."""

    name: str
    sigma: float
    delay: float


CASES = (Case("4a", 0.5, 50.0), Case("4b", 5.0, 4.0), Case("4c", 50.0, 0.75))
SIGMAS = (0.5, 5.0, 50.0, 500.0)


def theoretical(sigma: float) -> float:
    """T_d of eq. (8) in seconds."""
    index = maneuvering_index(sigma**2, VARIANCE, INTERVAL)
    return float(random_walk_cutoff(index, ratio=RATIO, interval=INTERVAL))


def selective_al1(lag: int) -> Estimator:
    """Al1 with params["q"], up to params["cutoff"] seconds."""
    return selective(
        al1(random_walk_model(lambda p: p["q"], VARIANCE), lag), lambda p: p["cutoff"]
    )


def recovered(squared: np.ndarray) -> np.ndarray:
    """Share (V,) of the way from the first RMSE (drop) to the last (Al1 with everything)."""
    values, _ = rmses(squared)
    return (values[0] - values) / (values[0] - values[-1])


def reach(share: np.ndarray, level: float) -> float:
    """The first multiple of T_d at which `share` reaches `level`, on a line between the points."""
    above = int(np.argmax(share >= level))
    x, y = MULTIPLES[above - 1 : above + 1], share[above - 1 : above + 1]
    return float(x[0] + (x[1] - x[0]) * (level - y[0]) / (y[1] - y[0]))


def run(experiment: Experiment) -> None:
    """Simulates, filters with every cut-off at once, and draws; see the module's first line."""
    runs = experiment.size(40, 4)
    found = {
        case.name: experiment.piece(case.name, lambda c=case: _compared(experiment, c, runs))
        for case in CASES
    }
    swept_runs = experiment.options.runs or (2 if experiment.options.quick else 10)
    swept = {
        sigma: experiment.piece(f"delays-{sigma}", lambda s=sigma: _delays(experiment, s, swept_runs))
        for sigma in SIGMAS
    }  # fmt: skip
    experiment.arrays("random_walk", _dataset(found, swept))
    experiment.figure("fig4", random_walk_figures.methods(CASES, found, theoretical, MULTIPLES))
    for name, wide in (("fig5", False), ("fig6", True)):
        experiment.figure(name, random_walk_figures.delays(swept, DELAYS, theoretical, MULTIPLES, wide))
    steps = _steps(experiment)
    experiment.table(
        "delays", f"By mean delay, {swept_runs} runs of {steps} measurements",
        [row for sigma in SIGMAS for row in _by_delay(sigma, swept[sigma])],
        ["Where dropping costs less than 2 % of the RMSE the cut-off has nothing to recover."],
    )  # fmt: skip
    experiment.table(
        "cutoff", "How far the theoretical cut-off goes from drop to Al1",
        [_recovery(case, found[case.name]) for case in CASES],
    )  # fmt: skip
    experiment.table(
        "random_walk", f"Random walk, {runs} runs of {steps} measurements: RMSE [m]",
        [_methods(case, found[case.name]) for case in CASES],
        ["exact: all measurements in order of validity time, at a part of the arrivals.",
         "EWIF: all measurements, τ by gradient on other runs."],
    )  # fmt: skip
    experiment.finish()


def _steps(experiment: Experiment) -> int:
    return 500 if experiment.options.quick else 5000


def _simulated(experiment: Experiment, sigma: float, delay: float, runs: int, number: int):
    scenario = random_walk(sigma**2, VARIANCE, INTERVAL, delay, _steps(experiment))
    return scenario, simulate_batch(scenario, jax.random.split(experiment.key(number), runs))


def _swept(
    experiment: Experiment, sigma: float, batch: Simulation, report: Any
) -> dict[str, np.ndarray]:
    """Averages at every multiple of T_d."""
    cutoffs = np.where(np.isfinite(MULTIPLES), MULTIPLES, 0) * theoretical(sigma)
    cutoffs[-1] = np.inf
    scenario = random_walk()
    return sweep(
        selective_al1(history_needed(batch.measurements)),
        {"cutoff": cutoffs, "q": np.full(cutoffs.size, sigma**2)},
        batch, prior=scenario.prior, t0=0.0, chunk=experiment.options.chunk, progress=report,
    )  # fmt: skip


def _compared(experiment: Experiment, case: Case, runs: int) -> dict[str, Any]:
    """All methods on the same runs of one panel of Fig. 4."""
    label = f"{case.name}: Al1, all cut-offs"
    with experiment.timed(label), experiment.progress(label) as report:
        scenario, batch = _simulated(experiment, case.sigma, case.delay, runs, 0)
        found = _swept(experiment, case.sigma, batch, report)
    with experiment.timed(f"{case.name}: exact"):
        reach = 20 * theoretical(case.sigma) + 10 * case.delay
        found["exact"] = exact_late(
            random_walk_model(case.sigma**2, VARIANCE), scenario, batch, round(reach / INTERVAL)
        )
    estimator = ewif(random_walk_model(0.0, VARIANCE), tau=lambda p: p["tau"])
    gain = random_walk_gain(maneuvering_index(case.sigma**2, VARIANCE, INTERVAL))
    start = -INTERVAL / np.log1p(-float(gain))
    label = f"{case.name}: EWIF"
    with experiment.timed(label), experiment.progress(label) as report:
        _, seen = _simulated(experiment, case.sigma, case.delay, 4 if experiment.options.quick else 16, 1)
        loss = rmse_loss(estimator, seen.measurements, seen.truth, prior=None, t0=0.0)
        tuned = tune(loss, {"tau": start}, steps=60, progress=report)
        tau = np.asarray([tuned.params["tau"]])
        found["ewif"] = sweep(estimator, {"tau": tau}, batch, prior=None, t0=0.0)["squared_error"]
    return {**found, "tau": tau, "tau_same_gain": start}


def _delays(experiment: Experiment, sigma: float, runs: int) -> dict[str, Any]:
    """Al1 at every cut-off and mean delay: (V, D, R)."""
    label = f"σ_Q = {sigma:g}: mean delays"
    with experiment.timed(label), experiment.progress(label) as report:
        batches = [
            _simulated(experiment, sigma, delay, runs, 2 + i)[1] for i, delay in enumerate(DELAYS)
        ]
        found = _swept(experiment, sigma, joined(batches), report)
    return {name: x.reshape(x.shape[0], DELAYS.size, runs) for name, x in found.items()}


def _methods(case: Case, found: Any) -> dict[str, Any]:
    squared = found["squared_error"]
    return {
        "": case.name,
        "σ_Q": case.sigma,
        "mean delay [s]": case.delay,
        "T_d [s]": theoretical(case.sigma),
        "KF, drop": rmse(squared[0]),
        "selective Al1 at T_d": rmse(squared[AT_CUTOFF]),
        "Al1, all": rmse(squared[-1]),
        "exact": rmse(found["exact"]),
        "EWIF": rmse(found["ewif"][0]),
        "τ [s]": float(found["tau"][0]),
        "τ of the same gain [s]": float(found["tau_same_gain"]),
    }


def _recovery(case: Case, found: Any) -> dict[str, Any]:
    squared = found["squared_error"]
    share = recovered(squared)
    return {
        "": case.name,
        "maneuvering index": float(maneuvering_index(case.sigma**2, VARIANCE, INTERVAL)),
        "T_d [s]": theoretical(case.sigma),
        "recovered at T_d": f"{100 * share[AT_CUTOFF]:.0f} %",
        "50 % at [T_d]": reach(share, 0.5),
        "95 % at [T_d]": reach(share, 0.95),
        "at T_d minus Al1 [m]": paired(squared[AT_CUTOFF], squared[-1]),
        "at 2 T_d minus Al1 [m]": paired(squared[AT_CUTOFF + 2], squared[-1]),
    }


def _by_delay(sigma: float, found: Any) -> list[dict[str, Any]]:
    rows = []
    for i, delay in enumerate(DELAYS):
        squared = found["squared_error"][:, i]
        share, values = recovered(squared), rmses(squared)[0]
        counts = values[0] > 1.02 * values[-1]
        best = int(np.argmin(values))
        rows.append({
            "σ_Q": sigma,
            "T_d [s]": theoretical(sigma),
            "mean delay [s]": float(delay),
            "KF, drop": rmse(squared[0]),
            "at T_d": rmse(squared[AT_CUTOFF]),
            "Al1, all": rmse(squared[-1]),
            "recovered at T_d": f"{100 * share[AT_CUTOFF]:.0f} %" if counts else None,
            "95 % at [T_d]": reach(share, 0.95) if counts else None,
            "best cut-off [T_d]": float(MULTIPLES[best]),
        })  # fmt: skip
    return rows


def _dataset(found: dict[str, Any], swept: dict[float, Any]) -> xr.Dataset:
    metres = {"units": "m"}
    at = {"cutoff_multiple": MULTIPLES, "mean_delay": ("mean_delay", DELAYS, {"units": "s"})}
    arrays: dict[str, xr.DataArray] = {}
    for case in CASES:
        one = found[case.name]
        rows = {"al1": one["squared_error"], "exact": one["exact"][None], "ewif": one["ewif"]}
        for name, squared in rows.items():
            dims = ("cutoff_multiple", "run") if name == "al1" else ("one", "run")
            coords = {"cutoff_multiple": MULTIPLES} if name == "al1" else {}
            attrs = {**metres, "sigma_Q": case.sigma, "mean_delay_s": case.delay}
            arrays[f"fig{case.name}_{name}_rmse_of_run"] = xr.DataArray(
                np.sqrt(squared), dims=dims, coords=coords, attrs=attrs
            )
    arrays["delays_rmse_of_run"] = xr.DataArray(
        np.sqrt(np.stack([swept[sigma]["squared_error"] for sigma in SIGMAS])),
        dims=("sigma_Q", "cutoff_multiple", "mean_delay", "swept_run"),
        coords={"sigma_Q": list(SIGMAS), **at}, attrs=metres,
    )  # fmt: skip
    arrays["cutoff_theory"] = xr.DataArray(
        [theoretical(sigma) for sigma in SIGMAS], dims="sigma_Q", attrs={"units": "s"}
    )
    return xr.Dataset(arrays)
