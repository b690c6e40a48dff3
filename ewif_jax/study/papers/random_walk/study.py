"""Random walks of Yoder et al., section 4.1 and Figs. 4-6: up to which delay is a late measurement
worth its while?"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax import Array

from ewif_jax.analysis.merit import maneuvering_index, random_walk_cutoff, random_walk_gain
from ewif_jax.estimators.ewif import ewif
from ewif_jax.monte_carlo import Simulation
from ewif_jax.oosm.al1 import al1
from ewif_jax.oosm.selective import selective
from ewif_jax.scenarios.random_walk import random_walk, random_walk_model
from ewif_jax.scores import average, scored, squared_error
from ewif_jax.study.papers.random_walk import figures
from ewif_jax.study.shared.experiment import Experiment
from ewif_jax.study.shared.late import exact_late, history_needed, paired, rmse_of, rmses_of, sweep
from ewif_jax.tuning import tune
from ewif_jax.types import Estimator, PyTree

VARIANCE, INTERVAL, RATIO = 2500.0, 0.2, 0.6
MULTIPLES = np.asarray([0, 0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1, 1.5, 2, 3, 5, 10, 30, 100, np.inf])
AT_CUTOFF = 7
"""where `MULTIPLES` holds 1"""
DELAYS = np.asarray([0.05, 0.2, 1.0, 5.0, 20.0, 100.0])


class WalkCase(NamedTuple):
    """One panel of Fig. 4: process noise sigma_Q in m/sqrt(s) and mean delay in seconds."""

    name: str
    sigma: float
    delay: float


CASES = (WalkCase("4a", 0.5, 50.0), WalkCase("4b", 5.0, 4.0), WalkCase("4c", 50.0, 0.75))
SIGMAS = (0.5, 5.0, 50.0, 500.0)
SWEPT = tuple(WalkCase("", sigma, delay) for sigma in SIGMAS for delay in DELAYS)
"""Figs. 5 and 6"""


def theoretical(sigma: float) -> float:
    """T_d of eq. (8) in seconds."""
    index = maneuvering_index(sigma**2, VARIANCE, INTERVAL)
    return float(random_walk_cutoff(index, ratio=RATIO, interval=INTERVAL))


def walk_al1(lag: int) -> Estimator:
    """Al1 with params["q"], up to params["cutoff"] seconds."""
    return selective(al1(random_walk_model(lambda p: p["q"], VARIANCE), lag), lambda p: p["cutoff"])


def recovered(squared: np.ndarray) -> np.ndarray:
    """Share (V,) of the way from the first RMSE (drop) to the last (Al1 with everything)."""
    values, _ = rmses_of(squared)
    return (values[0] - values) / (values[0] - values[-1])


def reach(share: np.ndarray, level: float) -> float:
    """The first multiple of T_d at which `share` reaches `level`, on a line between the points."""
    above = int(np.argmax(share >= level))
    x, y = MULTIPLES[above - 1 : above + 1], share[above - 1 : above + 1]
    return float(x[0] + (x[1] - x[0]) * (level - y[0]) / (y[1] - y[0]))


def run(experiment: Experiment) -> None:
    """Simulates, filters with every cut-off at once, and draws; see the module's first line."""
    quick = experiment.options.quick
    steps, runs = 500 if quick else 5000, experiment.size(40, 4)
    few = experiment.options.runs or (2 if quick else 10)
    compared = experiment.piece("compared", lambda: _compared_methods(experiment, runs, steps))
    swept = experiment.piece(
        "swept",
        lambda: _by_cutoff(experiment, SWEPT, _simulated_cases(experiment, SWEPT, few, steps, 2)),
    )
    found = [{name: x[..., i, :] for name, x in compared.items()} for i in range(len(CASES))]
    panels = swept["squared_error"].reshape(MULTIPLES.size, len(SIGMAS), DELAYS.size, few)
    experiment.arrays("random_walk", _walk_arrays(compared, panels))
    experiment.figure("fig4", figures.method_panels(CASES, found, theoretical, MULTIPLES))
    for name, wide in (("fig5", False), ("fig6", True)):
        drawn = figures.delay_panels(panels, SIGMAS, DELAYS, theoretical, MULTIPLES, wide)
        experiment.figure(name, drawn)
    experiment.table(
        "delays",
        f"By mean delay, {few} runs of {steps} measurements: RMSE [m]",
        [_case_row(case, swept["squared_error"][:, i]) for i, case in enumerate(SWEPT)],
        ["Where dropping costs less than 2 % of the RMSE there is nothing to recover."],
    )
    experiment.table(
        "cutoff",
        "How far the theoretical cut-off goes from drop to Al1",
        [
            _recovery_ratio(case, one["squared_error"])
            for case, one in zip(CASES, found, strict=True)
        ],
    )
    experiment.table(
        "random_walk",
        f"Random walk, {runs} runs of {steps} measurements: RMSE [m]",
        [_methods_of(case, one) for case, one in zip(CASES, found, strict=True)],
        [
            "exact: all measurements in order of validity time, at a part of the arrivals.",
            "EWIF: all measurements, τ by gradient on other runs, start of the walk not told.",
            "4a varies most: dropping what is late has the expectation 6.04 ± 0.04 (2,000 runs of",
            "5,000), and a table of 40 such runs a standard error of 0.25.",
        ],
    )
    experiment.finish()


def _simulated_cases(
    experiment: Experiment, cases: Sequence[WalkCase], runs: int, steps: int, number: int
) -> Simulation:
    """`runs` runs of each case, one case after the other."""

    def one_run(q: Array, delay: Array, key: Array) -> Simulation:
        return random_walk(q, VARIANCE, INTERVAL, delay, steps).simulate(key)

    with experiment.timed("simulation"):
        q = jnp.repeat(jnp.asarray([case.sigma**2 for case in cases]), runs)
        delay = jnp.repeat(jnp.asarray([case.delay for case in cases]), runs)
        keys = jax.random.split(experiment.key(number), q.size)
        return jax.block_until_ready(jax.jit(jax.vmap(one_run))(q, delay, keys))


def _by_cutoff(
    experiment: Experiment, cases: Sequence[WalkCase], batch: Simulation
) -> dict[str, np.ndarray]:
    """Averages (V, C, R) of the selective filter at every multiple of each case's T_d."""
    label = f"Al1, all cut-offs of {len(cases)} cases"
    runs = batch.truth.shape[0] // len(cases)
    limits = np.asarray([theoretical(case.sigma) for case in cases])
    q = np.repeat([case.sigma**2 for case in cases], runs)
    scenario = random_walk()
    with experiment.timed(label), experiment.progress(label) as report:
        found = sweep(
            walk_al1(history_needed(batch.measurements)),
            {
                "cutoff": MULTIPLES[:, None] * np.repeat(limits, runs),
                "q": np.tile(q, (MULTIPLES.size, 1)),
            },
            batch,
            prior=scenario.prior,
            t0=0.0,
            chunk=experiment.options.chunk,
            progress=report,
        )
    return {name: x.reshape(-1, len(cases), runs) for name, x in found.items()}


def _compared_methods(experiment: Experiment, runs: int, steps: int) -> dict[str, np.ndarray]:
    """All methods on the same runs of the three cases of Fig. 4; arrays end in (C, R)."""
    batch = _simulated_cases(experiment, CASES, runs, steps, 0)
    found = _by_cutoff(experiment, CASES, batch)
    exact = []
    with experiment.timed("exact"):
        for i, case in enumerate(CASES):
            own = jax.tree.map(lambda x, i=i: x[i * runs : (i + 1) * runs], batch)
            window = round((20 * theoretical(case.sigma) + 10 * case.delay) / INTERVAL)
            model = random_walk_model(case.sigma**2, VARIANCE)
            exact.append(exact_late(model, random_walk(), own, window))
    estimator = ewif(random_walk_model(0.0, VARIANCE), tau=lambda p: p["tau"])
    same = np.asarray([-INTERVAL / np.log1p(-_steady_gain(case)) for case in CASES])
    few, label = 4 if experiment.options.quick else 16, "EWIF: tuning"
    seen = _simulated_cases(experiment, CASES, few, steps, 1)

    def loss(params: dict[str, Array]) -> Array:
        errors = scored(
            estimator,
            {"tau": jnp.repeat(params["tau"], few)},
            seen.measurements,
            seen.truth,
            scores={"squared": squared_error},
            prior=None,
            t0=0.0,
            params_per_run=True,
        )["squared"]
        cases = errors.reshape(len(CASES), -1)
        return jnp.sum(jnp.log(average(cases, 1))) / 2

    with experiment.timed(label), experiment.progress(label) as report:
        tau = tune(loss, {"tau": same}, steps=40, progress=report).params["tau"]
    with experiment.timed("EWIF"):
        each = {"tau": np.repeat(tau, runs)[None]}
        scores = sweep(estimator, each, batch, prior=None, t0=0.0)
    return {
        **found,
        "exact": np.stack(exact),
        "ewif": scores["squared_error"].reshape(len(CASES), runs),
        "tau": np.asarray(tau)[:, None],
        "tau_same_gain": same[:, None],
    }


def _steady_gain(case: WalkCase) -> float:
    return float(random_walk_gain(maneuvering_index(case.sigma**2, VARIANCE, INTERVAL)))


def _methods_of(case: WalkCase, found: PyTree) -> dict[str, Any]:
    squared = found["squared_error"]
    return {
        "": case.name,
        "sigma_Q": case.sigma,
        "mean delay [s]": case.delay,
        "T_d [s]": theoretical(case.sigma),
        "KF, drop": rmse_of(squared[0]),
        "selective Al1 at T_d": rmse_of(squared[AT_CUTOFF]),
        "Al1, all": rmse_of(squared[-1]),
        "exact": rmse_of(found["exact"]),
        "EWIF": rmse_of(found["ewif"]),
        "τ [s]": float(found["tau"][0]),
        "τ of the same gain [s]": float(found["tau_same_gain"][0]),
    }


def _recovery_ratio(case: WalkCase, squared: np.ndarray) -> dict[str, Any]:
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


def _case_row(case: WalkCase, squared: np.ndarray) -> dict[str, Any]:
    share, values = recovered(squared), rmses_of(squared)[0]
    counts = values[0] > 1.02 * values[-1]
    return {
        "sigma_Q": case.sigma,
        "T_d [s]": theoretical(case.sigma),
        "mean delay [s]": float(case.delay),
        "KF, drop": rmse_of(squared[0]),
        "at T_d": rmse_of(squared[AT_CUTOFF]),
        "Al1, all": rmse_of(squared[-1]),
        "recovered at T_d": f"{100 * share[AT_CUTOFF]:.0f} %" if counts else None,
        "95 % at [T_d]": reach(share, 0.95) if counts else None,
        "best cut-off [T_d]": float(MULTIPLES[np.argmin(values)]),
    }


def _walk_arrays(compared: dict[str, np.ndarray], panels: np.ndarray) -> xr.Dataset:
    metres, seconds = {"units": "m"}, {"units": "s"}
    multiple = {"cutoff_multiple": MULTIPLES}
    case = {"case": [c.name for c in CASES]}
    swept = {"sigma_Q": list(SIGMAS), "mean_delay": ("mean_delay", DELAYS, seconds)}

    def errors(squared: np.ndarray, dims: tuple[str, ...], coords: dict) -> xr.DataArray:
        return xr.DataArray(np.sqrt(squared), dims=dims, coords=coords, attrs=metres)

    return xr.Dataset(
        {
            "al1_rmse_of_run": errors(
                compared["squared_error"], ("cutoff_multiple", "case", "run"), {**multiple, **case}
            ),
            "exact_rmse_of_run": errors(compared["exact"], ("case", "run"), case),
            "ewif_rmse_of_run": errors(compared["ewif"], ("case", "run"), case),
            "ewif_tau": xr.DataArray(compared["tau"][:, 0], dims="case", attrs=seconds),
            "swept_al1_rmse_of_run": errors(
                panels,
                ("cutoff_multiple", "sigma_Q", "mean_delay", "swept_run"),
                {**multiple, **swept},
            ),
            "cutoff_theory": xr.DataArray(
                [theoretical(sigma) for sigma in SIGMAS], dims="sigma_Q", attrs=seconds
            ),
        }
    )
